"""What every parameter file of one run has in common."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.settings import Method
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import FileReference, HeldBack, JunctionResidual, Provenance, VehicleParameters

__all__ = [
    "REASONS",
    "RunIdentity",
    "by_branch",
    "current_moments",
    "held_back_lines",
    "junction_residual",
    "time_of_run",
]

REASONS: dict[HeldBack, str] = {
    "beyond the limits": "it is beyond the limits of the layout: replace the sensor",
    "does not fit": "no gain error and offset explain what the sensor shows",
    "reference in doubt": "what it is compared with, the fleet or a known sensor, is in doubt",
    "moved too little": "its current moved too little for the gain to be known",
    "harm limit": "the correction might do harm",
}
"""Why a fault that was found is not corrected, in words."""


QUIET_SHARE = 0.25
"""Share of the blocks, those with the least throughput, that show how far sums at rest are from what is expected."""
STABILITY = 0.01
"""Least change of gains with temperature between drives that is assumed: the node must not take it for a fault. [1]"""
TINY_A2 = 1e-12
"""Least squared throughput, so that it can be divided by. [A^2]"""


@dataclass(frozen=True, kw_only=True)
class RunIdentity:
    """Identity of one run of the calibrator, as parameter files record it.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout that the parameters belong to.
    method : Method
        Method by which they are found.
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
        """Describe where the parameters of one vehicle come from."""
        return Provenance(
            tool=self.tool,
            method=self.method.value,
            created=self.created,
            fleet=self.fleet,
            fleet_size=fleet_size,
            drives=list(drives),
            duration_s=round(duration_s, 3),
        )


def time_of_run() -> str:
    """Return the time now in ISO 8601, or that of SOURCE_DATE_EPOCH if set, so that results are the same to the bit.

    Raises
    ------
    FleetError
        If SOURCE_DATE_EPOCH is no number of seconds.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    if epoch is not None and not epoch.isdecimal():
        raise FleetError(f"SOURCE_DATE_EPOCH is {epoch!r}; expected seconds since 1970, or leave it unset")
    now = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return now.isoformat(timespec="seconds")


def by_branch(branches: Sequence[str], values: Array) -> dict[str, float]:
    """Return the values of the branches by their names."""
    return dict(zip(branches, values.tolist(), strict=True))


def current_moments(mean_a: Array, product_a2: Array) -> Array:
    """Arrange the moments of the measured currents and of 1 as one block.

    Parameters
    ----------
    mean_a : ndarray of shape (K,)
        Mean measured currents. [A]
    product_a2 : ndarray of shape (K, K)
        Mean products of measured currents. [A^2]

    Returns
    -------
    ndarray of shape (1, K + 1, K + 1)
        Mean products of (i_m,1 ... i_m,K, 1).
    """
    row = np.append(mean_a, 1.0)
    return np.block([[product_a2, mean_a[:, None]], [row[None, :]]])[None]


def junction_residual(moments: Array, *, gain: Array, offset_a: Array, expected_a: float) -> JunctionResidual:
    """Compute the Kirchhoff sum before and after the correction of given sensor faults.

    Parameters
    ----------
    moments : ndarray of shape (B, K + 1, K + 1)
        Sums or means of products of (i_m,1 ... i_m,K, 1), of each block of the drives. [A^2]
    gain : ndarray of shape (B, K) or (1, K)
        Divisor of each current, 1 where it is not corrected. [1]
    offset_a : ndarray of shape (K,)
        Offset that is subtracted before that. [A]
    expected_a : float
        Mean sum that faultless sensors would show: the load that none of them sees. [A]

    Returns
    -------
    JunctionResidual
        Of sum_k i_m,k and sum_k (i_m,k - o_k) / gain_k over all valid samples.
    """
    weight = np.broadcast_to(1.0 / gain, (len(moments), gain.shape[1]))
    corrected = np.column_stack([weight, -weight @ offset_a])
    measured = np.column_stack([np.ones_like(weight), np.zeros(len(weight))])
    samples = float(moments[:, -1, -1].sum())

    def rms(sums: Array) -> float:
        return float(np.sqrt(max(float(np.einsum("bk,bkl,bl->", sums, moments, sums)) / samples, 0.0)))

    def mean(sums: Array) -> float:
        return float(np.einsum("bk,bk->", sums, moments[:, :, -1])) / samples

    sd_a, sd_per_a = _spread(moments / samples, corrected - np.append(np.zeros_like(offset_a), expected_a))
    return JunctionResidual(
        measured_a=rms(measured),
        corrected_a=rms(corrected),
        correction_a=rms(measured - corrected),
        measured_mean_a=mean(measured),
        corrected_mean_a=mean(corrected),
        expected_a=expected_a,
        corrected_sd_a=sd_a,
        corrected_sd_per_a=sd_per_a,
    )


def _spread(moments: Array, sums: Array) -> tuple[float, float]:
    """Return the deviation of single sums at rest [A] and per ampere of throughput [1], from moments (B, K + 1, K + 1).

    The quarter of the blocks with the least throughput gives that at rest; the excess of all blocks over it is taken to
    grow with the throughput. Half the sum of the squared currents stands for the squared throughput and is not more.
    """
    share, weight = moments[:, -1, -1], sums[:, :-1]
    square_a2 = np.maximum(np.einsum("bk,bkl,bl->b", sums, moments, sums), 0.0)
    throughput_a2 = 0.5 * np.einsum("bk,bkk->b", weight**2, moments[:, :-1, :-1])
    level = throughput_a2 / share
    quiet = level <= np.quantile(level, QUIET_SHARE)
    rest_a2 = float(square_a2[quiet].sum() / share[quiet].sum())
    growth = max(float(square_a2.sum()) - rest_a2, 0.0) / max(float(throughput_a2.sum()), TINY_A2)
    return math.sqrt(rest_a2), min(math.hypot(math.sqrt(growth), STABILITY), 1.0)  # 1 with a dead sensor


def held_back_lines(parameters: VehicleParameters) -> list[str]:
    """Say which faults that were found are not corrected, and why: a line per reason."""
    lines = []
    for reason, why in REASONS.items():
        held_back = {name: branch for name, branch in parameters.branches.items() if branch.held_back == reason}
        harm = [branch.harm_probability for branch in held_back.values() if branch.harm_probability is not None]
        shares = ", ".join(f"{share:.2%}" for share in harm)
        more = f", with a probability of {shares} (see --harm-limit)" if reason == "harm limit" and harm else ""
        lines += [f"{', '.join(held_back)} not corrected, because {why}{more}"] if held_back else []
    return lines
