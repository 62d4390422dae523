"""Fleet model: read-outs, slopes and intercepts of fleets whose faults are known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.evidence import fit_fleet_model, regress_on_fleet, stack_summaries
from calibrator.faults import Faults
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from tests.calibrator.estimator.simulated_drives import (
    PERIOD_S,
    Conditions,
    coloured,
    drive_of,
    no_faults,
    read_out_of,
    summaries_of,
)

K = 3


def one_sided_faults(vehicles: int, share: float) -> Faults:
    """Sensors that read too much, all with the same sign: the mean of the fleet is far from the ideal."""
    rng = np.random.default_rng(vehicles)
    faulty = rng.random((2, vehicles, K)) < share
    size = rng.uniform(0.05, 0.25, size=(2, vehicles, K)) * faulty
    return replace(no_faults(vehicles, K), drift=size[0], offset_a=400.0 * size[1])


def model_of(summaries: Sequence[DriveSummary]) -> Array:
    return fit_fleet_model(stack_summaries(summaries))


def slopes_of(summaries: Sequence[DriveSummary]) -> tuple[Array, Array]:
    fits = regress_on_fleet(stack_summaries(summaries), model_of(summaries))
    a, b = np.stack([fit.estimate for fit in fits], axis=2).transpose(1, 0, 2)
    return a, b


def scaled(summary: DriveSummary, column: int, factor: float) -> DriveSummary:
    """The same with an input or current in another unit."""
    scale = np.ones(summary.moments.shape[1])
    scale[column] = factor
    return replace(summary, moments=summary.moments * np.outer(scale, scale))


def largest_error(read_out: Array) -> float:
    """Of the read-outs, relative to each branch's largest."""
    W = read_out_of(K)
    return float(np.max(np.abs(read_out[:-1] - W) / np.abs(W).max(axis=0)))


@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.long), 0.5])
def test_read_outs_are_those_of_faultless_vehicles_however_lopsided_the_faults(share: float) -> None:
    read_out = model_of(summaries_of(one_sided_faults(40, share)))
    assert largest_error(read_out) < 0.005
    assert np.abs(read_out[-1]).max() < 0.5
    np.testing.assert_allclose(read_out.sum(axis=1), 0.0, atol=1e-9)


def test_order_of_vehicles_units_and_copies_of_inputs_do_not_matter() -> None:
    summaries = list(summaries_of(one_sided_faults(20, 0.3)))
    plain = model_of(summaries)
    np.testing.assert_allclose(model_of(summaries[::-1]), plain, atol=1e-6)
    other = model_of([scaled(summary, 0, 3.6) for summary in summaries])
    np.testing.assert_allclose(other * np.array([[3.6], [1.0], [1.0], [1.0]]), plain, atol=1e-5)
    columns = [0, 0, *range(1, summaries[0].moments.shape[1])]
    twice = [replace(summary, moments=summary.moments[:, columns][:, :, columns]) for summary in summaries]
    np.testing.assert_allclose(slopes_of(twice)[0], slopes_of(summaries)[0], atol=1e-4)


@pytest.mark.parametrize("varying", [0, 3])
def test_input_that_stands_still_in_most_vehicles_is_learnt_from_the_others(varying: int) -> None:
    """Of the mass of a vehicle, say: where it stands still its variance is rounding, which must not be divided by."""
    rng, summaries, told = np.random.default_rng(8), [], np.array([0.1, -0.1, 0.0])
    for j in range(12):
        drive = drive_of(rng, no_faults(1, K).take(0), Conditions())
        change = 50.0 * coloured(rng, len(drive.inputs), 1, 0.9) * (j < varying)
        inputs = np.hstack([drive.inputs, round(rng.uniform(1500.0, 2300.0), 3) + change])
        names = (*drive.input_names, "mass")
        drive = replace(drive, input_names=names, inputs=inputs, currents_a=drive.currents_a + change * told)
        summaries.append(summarise_samples([drive], period_s=PERIOD_S))
    np.testing.assert_allclose(model_of(summaries)[-2], told * bool(varying), atol=2e-4)  # [A] per kg


def test_vehicle_with_an_input_in_another_unit_does_not_bend_the_model() -> None:
    summaries = list(summaries_of(no_faults(20, K), seed=4))
    plain = largest_error(model_of(summaries))
    summaries[3] = scaled(summaries[3], 0, 1000.0)
    assert largest_error(model_of(summaries)) < 1.5 * plain + 1e-3
