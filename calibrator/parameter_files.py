"""What every parameter file of one run has in common."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.evidence.summary import DriveSummary
from calibrator.options import Method
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import FileReference, Provenance

__all__ = [
    "RunIdentity",
    "by_branch",
    "correction_rms_a",
    "junction_rms_a",
    "junction_rms_of_blocks_a",
]


@dataclass(frozen=True, kw_only=True)
class RunIdentity:
    """One run of the calibrator.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout that the parameters belong to.
    method : Method
        How they are found.
    fleet, created : str
        Name of the fleet; time, ISO 8601.
    """

    database: VehicleDatabase
    method: Method
    fleet: str
    created: str

    @property
    def tool(self) -> str:
        """Name and version of the program."""
        return f"calibrator {__version__}"

    @property
    def layout(self) -> FileReference:
        """The layout file."""
        return FileReference(name=self.database.layout.name, sha256=self.database.layout.digest)

    @property
    def dbc(self) -> FileReference:
        """The DBC file."""
        return FileReference(name=self.database.layout.dbc_path.name, sha256=self.database.digest)

    def provenance(self, *, fleet_size: int, drives: Sequence[str], duration_s: float) -> Provenance:
        """Where the parameters of one vehicle come from."""
        return Provenance(
            tool=self.tool,
            method=self.method.value,
            created=self.created,
            fleet=self.fleet,
            fleet_size=fleet_size,
            drives=list(drives),
            duration_s=round(duration_s, 3),
        )


def by_branch(branches: Sequence[str], values: Array) -> dict[str, float]:
    """Values of the branches by name."""
    return dict(zip(branches, values.tolist(), strict=True))


def junction_rms_a(mean_a: Array, product_a2: Array, *, drift: Array, offset_a: Array) -> float:
    """Root mean square of the Kirchhoff sum after correction with given sensor faults.

    Parameters
    ----------
    mean_a : ndarray of shape (K,)
        Mean measured currents. [A]
    product_a2 : ndarray of shape (K, K)
        Mean products of measured currents. [A^2]
    drift, offset_a : ndarray of shape (K,)
        Sensor faults to correct; zeros give the sum of the measured currents. [1], [A]

    Returns
    -------
    float
        RMS of sum_k (i_m,k - o_k) / (1 + d_k) over all valid samples. [A]
    """
    weight = 1.0 / (1.0 + drift)
    constant = float(weight @ offset_a)
    mean_square = weight @ product_a2 @ weight - 2.0 * constant * float(weight @ mean_a) + constant**2
    return float(np.sqrt(max(float(mean_square), 0.0)))


def correction_rms_a(mean_a: Array, product_a2: Array, *, drift: Array, offset_a: Array) -> float:
    """Root mean square of what the correction takes from the Kirchhoff sum.

    Parameters
    ----------
    mean_a, product_a2, drift, offset_a :
        As for :func:`junction_rms_a`.

    Returns
    -------
    float
        RMS of sum_k i_m,k - (i_m,k - o_k) / (1 + d_k) over all valid samples. [A]
    """
    weight = 1.0 / (1.0 + drift)
    change, constant = 1.0 - weight, float(weight @ offset_a)
    mean_square = change @ product_a2 @ change + 2.0 * constant * float(change @ mean_a) + constant**2
    return float(np.sqrt(max(float(mean_square), 0.0)))


def junction_rms_of_blocks_a(summary: DriveSummary, *, gain: Array, offset_a: Array) -> float:
    """Root mean square of the Kirchhoff sum where the gains of the sensors differ between the blocks of the drives.

    Parameters
    ----------
    summary : DriveSummary
        Of B blocks.
    gain : ndarray of shape (B, K)
        What each current is divided by. [1]
    offset_a : ndarray of shape (K,)
        What is taken from it before. [A]

    Returns
    -------
    float
        RMS of sum_k (i_m,k - o_k) / gain_k over all valid samples. [A]
    """
    weight = 1.0 / gain
    combined = np.column_stack([weight, -weight @ offset_a])
    moments = summary.moments[:, summary.inputs :, summary.inputs :]
    square = np.einsum("bk,bkl,bl->", combined, moments, combined)
    return float(np.sqrt(max(float(square) / float(summary.total[-1, -1]), 0.0)))
