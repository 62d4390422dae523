"""Parameter files of a result: rows of ``RESULT/parameters/NNNNN.parquet``, by the bucket of the vehicle.

For up to :data:`MOST_FILES` vehicles each is also a file ``RESULT/params/VEHICLE.json``: a folder of a million files is
no use.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.errors import FleetError
from calibrator.evidence.vehicle_evidence import VehicleEvidence
from ecu_node.user_files import write_atomically

__all__ = [
    "MOST_FILES",
    "PARAMETERS_SCHEMA",
    "PARTS",
    "Written",
    "evidence_columns",
    "read_part",
    "write_parameter_files",
]

MOST_FILES = 10_000
"""Vehicles whose parameters are files of their own in one folder."""
PARTS, FILES = "parameters", "params"
PARAMETERS_SCHEMA = pa.schema(
    [
        pa.field("vehicle", pa.string(), nullable=False),
        pa.field("drives", pa.string(), nullable=False, metadata={"meaning": "digest of the drives' files"}),
        pa.field("parameters", pa.string(), nullable=False, metadata={"meaning": "text of the parameter file"}),
        pa.field("evidence_value", pa.list_(pa.float32()), metadata={"meaning": "rows named in run.json"}),
        pa.field("evidence_sd", pa.list_(pa.float32()), metadata={"meaning": "standard deviation of the same"}),
        pa.field("evidence_explained", pa.list_(pa.float32()), metadata={"meaning": "what the estimate makes of it"}),
    ]
)


@dataclass(frozen=True, kw_only=True)
class Written:
    """Parameters of one vehicle as they were written.

    Attributes
    ----------
    drives : str
        Digest of the drives' files; empty if it is not known.
    text : bytes
        Of the parameter file.
    evidence : VehicleEvidence or None
        What they were found from; None if it was not kept.
    """

    drives: str
    text: bytes
    evidence: VehicleEvidence | None = None


def evidence_columns(evidence: VehicleEvidence | None) -> dict[str, list[float | None] | list[float]]:
    """Columns of :data:`PARAMETERS_SCHEMA` with the evidence of a vehicle; none if it was not kept."""
    if evidence is None:
        return {}
    return {f"evidence_{name}": values for name, values in vars(evidence).items()}


def _evidence_of(row: Mapping[str, Any]) -> VehicleEvidence | None:
    if row.get("evidence_value") is None:
        return None
    return VehicleEvidence(value=row["evidence_value"], sd=row["evidence_sd"], explained=row["evidence_explained"])


def read_part(path: Path) -> dict[str, Written]:
    """Parameters of a chunk by vehicle, from a file of a result; none if there is no such file.

    Raises
    ------
    FleetError
        If the file is damaged.
    """
    try:
        rows = pq.ParquetFile(path).read(use_threads=False).to_pylist()
        return {
            row["vehicle"]: Written(drives=row["drives"], text=row["parameters"].encode(), evidence=_evidence_of(row))
            for row in rows
        }
    except FileNotFoundError:
        return {}
    except (pa.ArrowException, OSError, KeyError) as error:
        reason = str(error).partition("\n")[0][:120]
        raise FleetError(f"{path}: damaged part of a result: {reason}; calibrate again") from None


def write_parameter_files(folder: Path, parts: Mapping[int, Path], *, vehicles: int) -> str:
    """Write the parameter files of a result.

    Parameters
    ----------
    folder : Path
        Of the result; it must exist.
    parts : mapping of int to Path
        Files with the parameters of each chunk, by its number.
    vehicles : int
        How many there are in all.

    Returns
    -------
    str
        Where they are for the user, within the folder.
    """
    (folder / PARTS).mkdir()
    for number, part in parts.items():
        shutil.copyfile(part, folder / PARTS / f"{number:05d}.parquet")
    if vehicles > MOST_FILES:
        return PARTS
    (folder / FILES).mkdir()
    for part in parts.values():
        for vehicle, written in read_part(part).items():
            write_atomically(folder / FILES / f"{vehicle}.json", written.text)
    return FILES
