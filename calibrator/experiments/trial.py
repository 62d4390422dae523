"""One trial: a random fleet with known faults, and what a method is given of it; sections IV-B to IV-D of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.published.evidence import FleetEvidence

__all__ = ["FleetLaw", "Trial", "UnseenDrive", "unseen_drive"]

TRAINING_VEHICLES = 3000
"""Size of the artificial fleet that trees learn from, section V-B."""


@dataclass(frozen=True, kw_only=True)
class FleetLaw:
    """How the fleets of an experiment are drawn, section IV-B of [1]_.

    Attributes
    ----------
    vehicles : int
        Fleet size N, a multiple of 4 for a symmetric fleet.
    training_vehicles : int
        Size of the artificial fleet to learn from.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        a, b: drifts [1], offsets in fractions of full scale.
    snr_db : float
        Of the artificial simulation (26). [dB]
    balanced, symmetric : bool
        See :func:`~calibrator.artificial.random_fleet.draw_faults`.
    sign_bias : float
        Faults are positive with probability 0.5 + sign_bias. [1]
    """

    vehicles: int = 1000
    training_vehicles: int = TRAINING_VEHICLES
    sparsity: float = 60.0
    magnitude: tuple[float, float] = (0.05, 0.25)
    snr_db: float = 20.0
    balanced: bool = True
    symmetric: bool = True
    sign_bias: float = 0.0

    def draw(self, rng: np.random.Generator, *, vehicles: int, branches: int, full_scale_a: float) -> Faults:
        """Draw the faults of a fleet of this law."""
        return draw_faults(
            rng,
            vehicles=vehicles,
            branches=branches,
            sparsity=self.sparsity,
            magnitude=self.magnitude,
            full_scale_a=full_scale_a,
            balanced=self.balanced,
            symmetric=self.symmetric,
            sign_bias=self.sign_bias,
        )


@dataclass(frozen=True, kw_only=True)
class UnseenDrive:
    """Moments of each vehicle's true currents on a drive that no method has seen.

    Attributes
    ----------
    mean_a, mean_square_a2 : ndarray of shape (N, K)
        [A], [A^2]
    """

    mean_a: Array
    mean_square_a2: Array


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What a method is given, and the truth it is judged by.

    Attributes
    ----------
    smallest_fault : float
        Smallest magnitude of a fault of the fleet. [1]
    full_scale_a : float
        Full scale of the junction. [A]
    truth : Faults
        Of N vehicles; only the perfect classifier may look.
    unseen : UnseenDrive
        Where corrections are judged.
    posterior : callable
        Runs the default method, with a prior of the faults or, for None, one that it estimates.
    law : FaultPrior or None
        How the faults were drawn; only the method that is to show the ceiling may look.
    collect : callable
        Makes the evidence of the published method.
    training : callable or None
        Makes the evidence and truth of an artificial fleet that the published method's trees learn from; None: there
        is none, and trees cannot be used.
    delay_error_s : ndarray of shape (N, K - 1) or None
        Error of the delays that were estimated and taken out, if they were. [s]
    """

    smallest_fault: float
    full_scale_a: float
    truth: Faults
    unseen: UnseenDrive
    posterior: Callable[[FaultPrior | None], FleetPosterior]
    collect: Callable[[], FleetEvidence]
    law: FaultPrior | None = None
    training: Callable[[], tuple[FleetEvidence, Faults]] | None = None
    delay_error_s: Array | None = None

    @cached_property
    def evidence(self) -> FleetEvidence:
        """Evidence of the published method."""
        return self.collect()


def unseen_drive(
    mean_a: Array, mean_square_a2: Array, truth: Faults, *, unmeasured_a: Array | None = None
) -> UnseenDrive:
    """True currents (11) of vehicles, by their moments.

    Parameters
    ----------
    mean_a, mean_square_a2 : ndarray of shape (K,) or (N, K)
        Moments of the ideal currents, of one drive for all vehicles or of one for each. [A], [A^2]
    truth : Faults
        Of N vehicles.
    unmeasured_a : ndarray of shape (N,) or None
        Load that no branch measures, carried by the first branch. [A]

    Returns
    -------
    UnseenDrive
        Of the N vehicles.
    """
    gain, constant = 1.0 + truth.hardware_drift[:, None], truth.hardware_offset_a.copy()
    if unmeasured_a is not None:
        constant[:, 0] += unmeasured_a
    return UnseenDrive(
        mean_a=gain * mean_a + constant,
        mean_square_a2=gain**2 * mean_square_a2 + 2.0 * gain * constant * mean_a + constant**2,
    )
