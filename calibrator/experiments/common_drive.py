"""The one drive that all vehicles of an experiment make, section IV-A of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np

from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.artificial.ground_truth import with_branches
from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.random_streams import Purpose, random_stream

__all__ = ["CommonDrive", "builtin_common_drive"]

TRAIN_SHARE = 0.8
"""Share of the drive on which models are trained; the rest is the unity drive, section IV-C. [1]"""
DURATION_S = 3600.0
"""An hour: 7,200 samples of unity drive at 10 Hz; the paper does not say. [s]"""
BRANCHES = ("battery", "motor", "auxiliary", "dcdc", "motor_rear")
BALANCE = "motor"
FULL_SCALE_A = 400.0
"""Nominal maximum current of the built-in vehicle's junction, as in its layout. [A]"""


@dataclass(frozen=True, kw_only=True)
class CommonDrive:
    """Ideal currents and inputs of one drive.

    Attributes
    ----------
    name : str
        What it is, for the record.
    i_s : ndarray of shape (T, K)
        Ideal currents, positive into the junction; each row sums to zero. [A]
    inputs : ndarray of shape (T, M)
        Inputs of the vehicle model.
    full_scale_a : float
        Full scale of the junction. [A]
    unseen : ndarray of shape (T', K)
        Ideal currents of another drive, on which corrections are judged. [A]
    """

    name: str
    i_s: Array
    inputs: Array
    full_scale_a: float
    unseen: Array

    def __post_init__(self) -> None:
        if self.i_s.ndim != 2 or len(self.i_s) != len(self.inputs):
            raise DriveError(f"drive {self.name}: {self.i_s.shape} currents do not fit {self.inputs.shape} inputs")
        worst = float(np.abs(self.i_s.sum(axis=1)).max(initial=0.0))
        if not worst <= 1e-6 * self.full_scale_a:
            raise DriveError(f"drive {self.name}: ideal currents must sum to zero; the worst sum is {worst:.3g} A")

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.i_s.shape[1])

    @property
    def unity_start(self) -> int:
        """First sample of the unity drive, T_1 of section IV-C."""
        return int(TRAIN_SHARE * len(self.i_s))

    @property
    def unity(self) -> Array:
        """Ideal currents on the unity drive, shape (T - T_1, K). [A]"""
        return self.i_s[self.unity_start :]


def builtin_common_drive(*, branches: int = 2, seed: int = 0, duration_s: float = DURATION_S) -> CommonDrive:
    """Take the common drive from the built-in vehicle.

    Parameters
    ----------
    branches : int
        Number of branches K, 2 to 5: battery and motor first; the motor takes the balance (19).
    seed : int
        Which trip.
    duration_s : float
        Least duration. [s]

    Returns
    -------
    CommonDrive
        With the model inputs of ``dbc/hv_powertrain.toml``.

    Raises
    ------
    FleetError
        If fastsim is not installed.
    """
    trip = builtin_trip(random_stream(Purpose.COMMON_DRIVE, seed), duration_s=duration_s, name=f"builtin-{seed}")
    trip = with_branches(trip, BRANCHES[:branches], BALANCE)
    unseen = builtin_trip(random_stream(Purpose.UNSEEN_TRIP, seed), duration_s=duration_s, name="unseen")
    x, voltage = trip.inputs, trip.inputs["voltage"]
    power = x["torque"] * x["speed"]
    inputs = (
        np.maximum(power, 0.0) / voltage,
        np.minimum(power, 0.0) / voltage,
        x["torque"] ** 2 / voltage,
        x["heater_demand"] / voltage,
        x["aircon_demand"] / voltage,
        x["low_voltage_demand"] / voltage,
    )
    return CommonDrive(
        name=trip.name,
        i_s=trip.matrix_a(),
        inputs=np.stack(inputs, axis=1),
        full_scale_a=FULL_SCALE_A,
        unseen=with_branches(unseen, BRANCHES[:branches], BALANCE).matrix_a(),
    )
