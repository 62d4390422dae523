"""Truth of an artificial fleet: ``truth.json``, written by ``calibrator simulate`` and read by ``calibrator score``."""

from pathlib import Path
from typing import Literal

import msgspec

from calibrator.errors import FleetError
from ecu_node.documents import write_atomically

__all__ = ["TRUTH_FILE", "FleetTruth", "VehicleTruth", "read_truth", "write_truth"]

TRUTH_FILE = "truth.json"

_REMEDY = "name the truth.json that 'calibrator simulate' wrote beside the logs"


class VehicleTruth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Faults and load of one vehicle, and moments of its currents.

    Mappings are by branch, currents positive into the junction; faults are those of :class:`calibrator.faults.Faults`.
    """

    hardware_drift: float
    hardware_offset_a: dict[str, float]
    drift: dict[str, float]
    offset_a: dict[str, float]
    delay_s: dict[str, float]
    """Delay of each measured current behind the true one. [s]"""
    unmeasured_a: float
    """Load that no branch measures, positive if it takes current out of the junction. [A]"""
    unseen_mean_a: dict[str, float]
    """Mean of the true currents on a drive that is not in the logs. [A]"""
    unseen_mean_square_a2: dict[str, float]
    """Mean square of the true currents on that drive. [A^2]"""


class FleetTruth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How an artificial fleet was made, and the truth about every vehicle in it."""

    schema_version: Literal[1] = 1
    layout: str
    branches: list[str]
    full_scale_a: float
    seed: int
    sparsity: float
    """Share of the fault parameters that are zero. [%]"""
    magnitude: tuple[float, float]
    """Range of fault magnitudes: drifts [1], offsets in fractions of full scale."""
    balanced: bool
    """Whether half of the vehicles cannot have a hardware fault."""
    symmetric: bool
    """Whether vehicles come in groups of four whose measured currents have the ideal current as their mean."""
    common_drive: bool
    """Whether all vehicles drive the same trip."""
    noise: float
    """Standard deviation of the sensor noise in fractions of full scale."""
    vehicles: dict[str, VehicleTruth]


def write_truth(path: Path, truth: FleetTruth) -> None:
    """Write ``truth.json`` whole, or not at all if writing fails."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(truth), indent=1) + b"\n")


def read_truth(path: Path) -> FleetTruth:
    """Read ``truth.json``; FleetError, which says what is wrong, if it cannot be read or is no such file."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=FleetTruth)
    except OSError as error:
        raise FleetError(f"{path}: cannot read the truth: {error.strerror}; {_REMEDY}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(f"{path}: not a truth.json of 'calibrator simulate': {error}; {_REMEDY}") from None
