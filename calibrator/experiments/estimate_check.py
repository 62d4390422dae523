"""Whether what a method returns is an estimate of the fleet that it was given: own methods may err."""

import numpy as np

from calibrator.errors import FleetError
from calibrator.experiments.methods import Estimate
from calibrator.faults import Faults

__all__ = ["require_estimate"]

SEE = "see Estimate of calibrator.experiments.methods"
ROUNDING = 1e-9
"""By which a probability may leave 0 to 1. [1]"""


def require_estimate(method: str, estimate: object, truth: Faults) -> Estimate:
    """Refuse what cannot be judged.

    Parameters
    ----------
    method : str
        Name of the method, for the message.
    estimate : object
        What it returned.
    truth : Faults
        Of the N vehicles with K branches that it was given.

    Returns
    -------
    Estimate
        The same.

    Raises
    ------
    FleetError
        If it is no estimate, or one of its arrays has another shape or type, or values that are not finite.
    """
    where = f"method '{method}'"
    if not isinstance(estimate, Estimate):
        raise FleetError(f"{where}: estimate() returned {_kind(estimate)}, expected an Estimate; {SEE}")
    faults = estimate.faults
    if not isinstance(faults, Faults):
        raise FleetError(f"{where}: faults are {_kind(faults)}, expected Faults of calibrator.faults; {SEE}")
    N, K = truth.drift.shape
    _require_numbers(f"{where}: faults.hardware_drift", faults.hardware_drift, (N,))
    _require_numbers(f"{where}: faults.hardware_offset_a", faults.hardware_offset_a, (N, K))
    _require_numbers(f"{where}: faults.drift", faults.drift, (N, K))
    _require_numbers(f"{where}: faults.offset_a", faults.offset_a, (N, K))
    _require_array(f"{where}: hardware", estimate.hardware, (N,), "b")
    _require_array(f"{where}: corrected", estimate.corrected, (N, K), "b")
    if estimate.confidence is not None:
        _require_probabilities(f"{where}: confidence", estimate.confidence, (N,))
    if not isinstance(estimate.failed, int | np.integer):
        raise FleetError(f"{where}: failed is {_kind(estimate.failed)}, expected a number of vehicles; {SEE}")
    return estimate


def _require_array(where: str, values: object, shape: tuple[int, ...], kinds: str) -> None:
    """FleetError if it is no array of that shape and of one of these kinds of numpy."""
    meant = f"expected an array of {'bool' if kinds == 'b' else 'numbers'} of shape {shape}: vehicles"
    meant += " and branches" if len(shape) > 1 else ""
    if not isinstance(values, np.ndarray):
        raise FleetError(f"{where} is {_kind(values)}, {meant}; {SEE}")
    if values.shape != shape or values.dtype.kind not in kinds:
        raise FleetError(f"{where} is an array of {values.dtype} of shape {values.shape}, {meant}; {SEE}")


def _require_numbers(where: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    _require_array(where, values, shape, "fiu")
    count = int(np.sum(~np.isfinite(values)))
    if count:
        raise FleetError(f"{where} has {count} values that are not finite; expected 0 where no fault is found; {SEE}")


def _require_probabilities(where: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    _require_array(where, values, shape, "fiu")
    count = int(np.sum(~((values >= -ROUNDING) & (values <= 1.0 + ROUNDING))))
    if count:
        raise FleetError(f"{where} has {count} values that are no probability; expected 0 to 1; {SEE}")


def _kind(value: object) -> str:
    return "None" if value is None else f"an object of type {type(value).__name__}"
