"""How a result was made: ``RESULT/run.json``."""

from pathlib import Path
from typing import Any

import msgspec

from calibrator.errors import FleetError
from ecu_node.user_files import write_atomically

__all__ = ["REMEDY", "RunRecord", "read_run", "write_run"]

REMEDY = "name a folder that 'calibrator calibrate --out' wrote"
"""What to do about a folder that is no result."""


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """How a result was made."""

    tool: str
    method: str
    fleet: str
    fleet_ids: list[str] = []
    """Artificial fleets that the drives come from; empty if they are recorded."""
    layout: str
    branches: list[str]
    model_inputs: list[str]
    settings: dict[str, Any]
    """What the user chose: hold-out and trusted vehicles, harm limit, or the published method's classifier."""
    created: str
    details: dict[str, Any]
    """What the method tells of its run: unity drive and simulation SNR, or reference, delays and hyper-parameters."""
    vehicles: int
    buckets: int = 0
    """Files that the parameters are spread over by the hash of the vehicle; 0: all are in the first."""
    left_out: dict[str, str]
    """Why vehicles have no parameters; of many the first ones."""
    left_out_count: int = 0
    full_scale_a: float = 0.0
    """Of the junction; 0: not known. [A]"""
    layout_sha256: str = ""
    dbc_sha256: str = ""
    notices: list[str]


def write_run(folder: Path, run: RunRecord) -> None:
    """Write ``run.json``."""
    write_atomically(folder / "run.json", msgspec.json.format(msgspec.json.encode(run), indent=2) + b"\n")


def read_run(result: Path) -> RunRecord:
    """``run.json`` of a result folder; FleetError if it is none."""
    path = result / "run.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except OSError as error:
        raise FleetError(f"{path}: not a result of 'calibrator calibrate': {error.strerror}; {REMEDY}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(f"{path}: not a run of 'calibrator calibrate': {error}; calibrate again") from None
