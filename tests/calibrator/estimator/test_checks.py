"""Misfits that no gain error and no offset explains are found and named, and nothing else is."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from calibrator.drive import Array, Samples
from calibrator.estimator.checks import find_misfits, learn_usual_misfits
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from ecu_node.parameters import SensorFinding
from tests.calibrator.estimator.simulated_drives import INPUTS, PERIOD_S, coloured, no_faults, read_out_of, samples_of
from tests.calibrator.estimator.simulated_rows import random_faults

BRANCHES = ("battery", "motor", "auxiliary")
FULL_SCALE_A = 400.0
SAMPLES = 3000
HOURS = np.linspace(0.0, 1.0, SAMPLES)
WARM_C = 10.0 + 25.0 * np.sqrt(HOURS)
BAD = 2
"""The vehicle whose sensor is not linear."""
Bend = Callable[[Array, np.random.Generator], Array]
"""What a sensor shows of the current that it should show. [A]"""

CAUSES: dict[str, Bend] = {
    "inverted": lambda x, _: -x,
    "dead": lambda x, _: np.full(len(x), 12.0),
    "clipped": lambda x, _: np.clip(x, -90.0, 90.0),
    "saturating": lambda x, _: np.where(np.abs(x) > 80.0, np.sign(x) * 80.0 + 0.7 * (x - np.sign(x) * 80.0), x),
    "quadratic": lambda x, _: x + 0.1 * x**2 / FULL_SCALE_A,
    "cubic": lambda x, _: x + 0.2 * x**3 / FULL_SCALE_A**2,
    "sign": lambda x, _: np.where(x > 0.0, 1.1 * x, x),
    "step": lambda x, _: x * np.where(HOURS > 0.6, 1.15, 1.0),
    "ramp": lambda x, _: x * (1.0 + 0.15 * HOURS),
    "temperature": lambda x, _: x * (1.0 + 0.006 * (WARM_C - 25.0)),
    "spikes": lambda x, rng: x + (rng.random(len(x)) < 0.008) * rng.uniform(40.0, 100.0, len(x)),
    "outliers": lambda x, rng: x + (rng.random(len(x)) < 0.008) * rng.choice([-80.0, 80.0], len(x)),
    "noise": lambda x, rng: x + (np.arange(len(x)) // 30 % 10 == 0) * rng.normal(0.0, 8.0, len(x)),
}


def a_drive(seed: int, faults: Faults, bend: Bend | None, branch: int = 0, load_a: Array | float = 0.0) -> Samples:
    """One drive; one sensor is nonlinear about its offset."""
    rng, K = np.random.default_rng(seed), len(faults.drift)
    u = coloured(rng, SAMPLES, INPUTS, 0.99) + np.array([0.5, 0.2, 0.0])
    error = 1.5 * coloured(rng, SAMPLES, K, 0.99)
    i = true_currents(u @ read_out_of(K), faults) + error - error.mean(axis=1, keepdims=True)
    i[:, 0] += load_a
    i_m = measured_currents(i, faults)
    if bend is not None:
        i_m[:, branch] = bend(i_m[:, branch] - faults.offset_a[branch], rng) + faults.offset_a[branch]
    return samples_of(u, i_m + rng.normal(0.0, 0.3, i_m.shape))


def a_fleet(K: int, bend: Bend | None = None, branch: int = 0, load_a: Array | float = 0.0) -> list[DriveSummary]:
    """Nine vehicles with gain errors and offsets, of which one has a bent sensor or a load without a sensor."""
    faults = random_faults(K, vehicles=9, branches=K, full_scale_a=FULL_SCALE_A)
    bad = (bend, branch, load_a)
    drives = [a_drive(10 + j, faults.take(j), *(bad if j == BAD else (None,))) for j in range(len(faults))]
    return [summarise_samples([drive], period_s=PERIOD_S, temperatures_c=[WARM_C]) for drive in drives]


def read_out(K: int) -> Array:
    return np.vstack([read_out_of(K), np.zeros(K)])


def checked(summaries: Sequence[DriveSummary], K: int) -> list[tuple[SensorFinding, ...]]:
    usual = learn_usual_misfits(summaries, read_out(K), full_scale_a=FULL_SCALE_A)
    return find_misfits(summaries, read_out(K), usual, full_scale_a=FULL_SCALE_A, branches=BRANCHES[:K])


@pytest.mark.parametrize("K", [2, 3])
@pytest.mark.parametrize("branch", [0, 1])
@pytest.mark.parametrize("cause", CAUSES)
def test_misfit_of_one_sensor_is_found_with_its_cause_and_blames_no_other(cause: str, branch: int, K: int) -> None:
    found = checked(a_fleet(K, CAUSES[cause], branch), K)
    if (cause, branch, K) == ("clipped", 1, 3):
        cause, branch = "switching", -1  # the clipping level is visible in no single other current
    probability = {each.cause: each.probability for each in found[BAD]}
    assert probability[cause] > 0.7
    assert {each.branch for each in found[BAD]} <= {None, *BRANCHES[branch : branch + 1]}
    assert [j for j, mine in enumerate(found) if mine] == [BAD]


@pytest.mark.parametrize("K", [2, 3])
def test_switched_load_is_found_without_blaming_a_sensor(K: int) -> None:
    on = np.repeat(np.random.default_rng(0).random(SAMPLES // 50) < 0.5, 50)
    found = checked(a_fleet(K, load_a=15.0 * on), K)
    assert [(each.cause, each.branch) for each in found[BAD]] == [("switching", None)]
    assert "load without a sensor" in found[BAD][0].text


@pytest.mark.parametrize("share", [0.15, -0.15])
def test_sensor_that_shows_a_share_of_another_branch_is_named_and_no_other(share: float) -> None:
    faults = random_faults(3, vehicles=9, branches=3, full_scale_a=FULL_SCALE_A)
    drives = [a_drive(10 + j, faults.take(j), None) for j in range(9)]
    stray = drives[BAD].currents_a.copy()
    stray[:, 2] += share * stray[:, 0]
    drives[BAD] = replace(drives[BAD], currents_a=stray)
    found = checked([summarise_samples([drive], period_s=PERIOD_S) for drive in drives], 3)
    assert [(each.cause, each.branch) for each in found[BAD]] == [("follows", "auxiliary")]
    sign, text = "+" if share > 0.0 else "-", found[BAD][0].text
    assert text.startswith(f"sensor auxiliary shows {sign}1")
    assert text.endswith("% of the current of battery, too: a stray field?")
    assert [j for j, mine in enumerate(found) if mine] == [BAD]


def test_share_of_another_branch_that_all_sensors_show_is_usual_also_for_a_vehicle_checked_alone() -> None:
    drives = [a_drive(10 + j, no_faults(1, 3).take(0), None) for j in range(9)]
    for drive in drives:
        drive.currents_a[:, 2] += 0.1 * drive.currents_a[:, 1]
    summaries = [summarise_samples([drive], period_s=PERIOD_S) for drive in drives]
    usual = learn_usual_misfits(summaries, read_out(3), full_scale_a=FULL_SCALE_A)
    check = partial(find_misfits, read_out=read_out(3), usual=usual, full_scale_a=FULL_SCALE_A, branches=BRANCHES)
    assert check(summaries) == [()] * 9
    assert [check([each]) for each in summaries] == [[()]] * 9


def test_vehicle_whose_third_branch_draws_more_has_no_finding() -> None:
    drives = [a_drive(10 + j, no_faults(1, 3).take(0), None) for j in range(9)]
    currents_a = drives[BAD].currents_a
    currents_a[:, 0] -= 0.5 * currents_a[:, 2]
    currents_a[:, 2] *= 1.5
    assert checked([summarise_samples([drive], period_s=PERIOD_S) for drive in drives], 3) == [()] * 9


def test_finding_of_a_gain_that_differs_by_sign_also_names_a_load_proportional_to_a_current() -> None:
    faults = no_faults(9, 2)
    drives = [a_drive(10 + j, faults.take(j), None) for j in range(9)]
    loaded = drives[BAD].currents_a.copy()
    loaded[:, 0] += 0.08 * np.abs(loaded[:, 1])
    drives[BAD] = replace(drives[BAD], currents_a=loaded)
    (finding,) = checked([summarise_samples([drive], period_s=PERIOD_S) for drive in drives], 2)[BAD]
    assert finding.cause == "sign"
    assert "or a load without a sensor takes 8 % of" in finding.text


@pytest.mark.parametrize("K", [2, 3])
def test_gain_errors_offsets_and_a_constant_load_are_not_findings(K: int) -> None:
    assert checked(a_fleet(K, load_a=8.0), K) == [()] * 9


def test_misfit_common_to_all_vehicles_is_not_a_finding() -> None:
    faults = no_faults(9, 2)
    bent = [a_drive(j, faults.take(j), lambda x, _: x + 0.03 * x**2 / FULL_SCALE_A) for j in range(9)]
    assert checked([summarise_samples([drive], period_s=PERIOD_S) for drive in bent], 2) == [()] * 9


def test_standing_vehicle_has_no_findings() -> None:
    summaries = a_fleet(2)
    still = samples_of(np.zeros((SAMPLES, INPUTS)), np.zeros((SAMPLES, 2)))
    found = checked([*summaries, summarise_samples([still], period_s=PERIOD_S)], 2)
    assert found == [()] * 10
