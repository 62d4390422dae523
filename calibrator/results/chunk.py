"""What some vehicles of a fleet gave. A fleet is calibrated in chunks, of which its result is put together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calibrator.evidence.vehicle_evidence import VehicleEvidence
from calibrator.results.left_out import left_out_rows
from calibrator.results.parameter_parts import PARAMETERS_SCHEMA, evidence_columns
from calibrator.results.parquet_bytes import parquet_bytes
from calibrator.results.rows import SCHEMA, vehicle_rows
from ecu_node.errors import ParameterError
from ecu_node.parameters import VehicleParameters, encode_parameters

__all__ = ["ChunkResult", "encode_chunk"]


@dataclass(frozen=True, kw_only=True)
class ChunkResult:
    """What some vehicles of a fleet gave, as files.

    Attributes
    ----------
    rows : bytes
        Their part of ``results.parquet``.
    parameters : bytes
        Parquet with the texts of their parameter files, see :data:`PARAMETERS_SCHEMA`.
    """

    rows: bytes
    parameters: bytes


def encode_chunk(
    parameters: Sequence[VehicleParameters],
    left_out: Mapping[str, str],
    *,
    moved: Mapping[tuple[str, str], str] | None = None,
    drives: Mapping[str, str] | None = None,
    evidence: Mapping[str, VehicleEvidence] | None = None,
) -> ChunkResult:
    """Write down what a chunk gave.

    Parameters
    ----------
    parameters : sequence of VehicleParameters
        One per calibrated vehicle; one whose parameters cannot be written is left out.
    left_out : mapping of str to str
        Why the other vehicles have none.
    moved : mapping of (str, str) to str, or None
        What has moved since an earlier result, by vehicle and branch.
    drives : mapping of str to str, or None
        Digest of the drives' files by vehicle.
    evidence : mapping of str to VehicleEvidence, or None
        What the parameters were found from, by vehicle.

    Returns
    -------
    ChunkResult
        In the order of the vehicles' names.
    """
    rows: list[dict[str, Any]] = []
    texts: list[dict[str, Any]] = []
    reasons = dict(left_out)
    for item in sorted(parameters, key=lambda item: item.vehicle):
        try:
            text = encode_parameters(item, f"parameters of {item.vehicle}").decode()
        except ParameterError as error:
            reasons[item.vehicle] = f"{error}; look at its recordings"
            continue
        texts.append(
            {
                "vehicle": item.vehicle,
                "drives": (drives or {}).get(item.vehicle, ""),
                "parameters": text,
                **evidence_columns((evidence or {}).get(item.vehicle)),
            }
        )
        rows += [{**row, "moved": (moved or {}).get((item.vehicle, row["branch"]))} for row in vehicle_rows(item)]
    rows += left_out_rows(reasons)
    return ChunkResult(rows=parquet_bytes(rows, SCHEMA), parameters=parquet_bytes(texts, PARAMETERS_SCHEMA))
