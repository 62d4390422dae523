"""Checks for misfit on recorded trips of the BMW i3: they name wrong sensors, and nearly none where all are linear."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Samples
from calibrator.estimator.checks import find_misfits, learn_usual_misfits
from calibrator.estimator.evidence import fit_fleet_model, stack_summaries
from calibrator.experiments.figures import judge
from calibrator.experiments.methods import POSTERIOR
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet, read_fleet, recorded_trial
from calibrator.faults import measured_currents, true_currents
from calibrator.files.layout_files import vehicle_database
from calibrator.summaries.summariser import summarise_samples
from ecu_node.parameters import SensorFinding
from tests.calibrator.estimator.simulated_rows import random_faults
from tests.real.conftest import LAYOUT

Bend = Callable[[Array, Array], Array]
"""What a sensor shows of its currents [A], given the share of the time that has passed."""
BENDS: dict[str, Bend] = {
    "inverted": lambda x, _: -x,
    "dead": lambda x, _: 0.0 * x,
    "clipped": lambda x, _: np.clip(x, -0.5 * np.abs(x).max(), 0.5 * np.abs(x).max()),
    "quadratic": lambda x, _: x + 0.15 * x**2 / 400.0,
    "sign": lambda x, _: np.where(x > 0.0, 1.12 * x, x),
    "step": lambda x, share: np.where(share > 0.5, 1.15 * x, x),
    "temperature": lambda x, share: x * (1.0 + 0.006 * 25.0 * np.sqrt(share)),
}


@pytest.fixture(scope="module")
def fleet(i3_store: Path) -> RecordedFleet:
    return read_fleet(i3_store, vehicle_database(LAYOUT))


def checked(fleet: RecordedFleet, branches: int, seed: int, bends: dict[int, Bend]) -> list[tuple[SensorFinding, ...]]:
    """Findings in a fleet with gain errors and offsets, in which the batteries' sensors of some vehicles are bent."""
    trips, rng, summaries = fleet.with_branches(branches), np.random.default_rng(seed), []
    full_scale_a = fleet.full_scale_a
    faults = random_faults(rng, vehicles=len(trips), branches=branches, sparsity=70.0, full_scale_a=full_scale_a)
    for j, trip in enumerate(trips):
        own, share = faults.take(j), np.arange(len(trip)) / len(trip)
        i_m = measured_currents(true_currents(trip.matrix_a(), own), own)
        if j in bends:
            i_m[:, 0] = bends[j](i_m[:, 0] - own.offset_a[0], share) + own.offset_a[0]
        inputs = fleet.inputs(trip)
        samples = Samples(
            branch_names=tuple(trip.currents_a),
            input_names=tuple(inputs),
            time_s=trip.time_s,
            currents_a=i_m + rng.normal(0.0, 0.4, i_m.shape),
            inputs=np.column_stack(list(inputs.values())),
            valid=np.ones(len(trip), bool),
        ).with_inputs(fleet.database.layout.fleet_inputs)
        warm_c = 10.0 + 25.0 * np.sqrt(share)
        summaries.append(summarise_samples([samples], period_s=fleet.period_s, temperatures_c=[warm_c]))
    read_out = fit_fleet_model(stack_summaries(summaries))
    usual = learn_usual_misfits(summaries, read_out, full_scale_a=fleet.full_scale_a)
    names = tuple(trips[0].currents_a)
    return find_misfits(summaries, read_out, usual, full_scale_a=fleet.full_scale_a, branches=names)


@pytest.mark.parametrize("branches", [2, pytest.param(3, marks=pytest.mark.long)])
def test_at_most_1_percent_of_vehicles_with_linear_sensors_have_a_finding(fleet: RecordedFleet, branches: int) -> None:
    found = [mine for seed in range(4) for mine in checked(fleet, branches, seed, {})]
    assert sum(map(bool, found)) <= 0.01 * len(found)


@pytest.mark.parametrize("branches", [2, pytest.param(3, marks=pytest.mark.long)])
def test_cause_and_branch_of_nonlinear_sensors_are_found_and_no_others(fleet: RecordedFleet, branches: int) -> None:
    vehicles = [int(j) for j in np.argsort([-np.ptp(trip.matrix_a()[:, 0]) for trip in fleet.with_branches(branches)])]
    put = dict(zip(vehicles[::3], BENDS, strict=False))
    found = checked(fleet, branches, 5, {j: BENDS[cause] for j, cause in put.items()})
    named = {j: (found[j][0].cause, found[j][0].branch) for j in put if found[j]}
    assert named == {j: (cause, "battery") for j, cause in put.items()}
    assert not any(mine for j, mine in enumerate(found) if j not in put)


@pytest.mark.parametrize("seed", [5, 13])
def test_corrections_do_no_harm_if_sound_sensors_have_small_errors(fleet: RecordedFleet, seed: int) -> None:
    trial = recorded_trial(fleet, RecordedCase(world="small errors in 30%"), seed)
    found = judge(POSTERIOR.estimate(trial), trial)
    assert np.all(found["recovery_rate"])
    assert not np.any(found["harmed"])
    assert np.mean(found["deployed"]) > 0.8
