"""What a fleet's task does with bench readings: those that the drives contradict are found, by vehicle and sensor."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from calibrator.estimator.fleet_estimate import estimate_vehicles, learn_fleet
from calibrator.estimator.fleet_task import _contradicted, _distrust
from calibrator.estimator.readings import BenchReading
from tests.calibrator.estimator.simulated_drives import Conditions, no_faults, summaries_of

FULL_SCALE_A, NAMES = 400.0, ("battery", "motor")


def test_bench_reading_that_the_drives_contradict_is_named_and_the_others_are_not() -> None:
    truth = no_faults(10, 2)
    truth.drift[4, 1] = 0.1
    summaries = summaries_of(truth, Conditions(samples=1200, model_error_a=0.5), seed=1)
    reference = learn_fleet(summaries, full_scale_a=FULL_SCALE_A, branches=NAMES)
    vehicles = [SimpleNamespace(vehicle=f"V{j}", summary=summary) for j, summary in enumerate(summaries)]

    def estimate(some: Any) -> Any:
        return estimate_vehicles([vehicle.summary for vehicle in some], reference)

    bench = {
        ("V7", "motor"): BenchReading(0.1, 0.001, np.nan, np.nan, "of V4"),
        ("V4", "motor"): BenchReading(0.1, 0.001, np.nan, np.nan, "as it is"),
        ("V4", "battery"): BenchReading(0.0, 0.001, 40.0, 0.1, "40 A too much"),
        ("V2", "battery"): BenchReading(np.nan, np.nan, 0.0, 0.1, "as it is"),
    }
    task = cast("Any", SimpleNamespace(branches=NAMES, estimate=estimate))
    wrong = _contradicted(task, cast("Any", vehicles), bench)
    assert list(wrong) == [("V7", "motor"), ("V4", "battery")]
    assert "vehicle V4: the bench reading of its battery sensor is not what its drives show" in wrong["V4", "battery"]
    assert _contradicted(task, cast("Any", vehicles[:1]), bench) == {}


def test_trusted_vehicles_that_do_not_carry_the_reference_are_named() -> None:
    shown = SimpleNamespace(offset_a=np.array([5.0, np.nan]), sd_a=np.array([0.1, np.nan]))
    vehicles = cast("Any", [SimpleNamespace(vehicle=f"V{j}", zero_current=shown) for j in range(2)])
    known = {"branches": NAMES, "full_scale_a": FULL_SCALE_A}
    reference = cast("Any", SimpleNamespace(distrusted={0: "it leaks"}, differing=(1,), **known))
    texts = _distrust(vehicles, np.array([True, True]), reference)
    assert texts[0] == "only 0 of the trusted vehicles can carry the reference, 3 are needed: it is the fleet's"
    assert texts[1] == "vehicle V0 is not trusted: it leaks; check it again"
    assert texts[2].startswith("trusted vehicle V1 does not carry the reference: it differs from the other trusted")
    assert texts[3].startswith("trusted vehicle V0: its battery sensor showed +5.0 A with open contactors")
    nobody = cast("Any", SimpleNamespace(distrusted={}, differing=(), **known))
    assert _distrust(vehicles, np.array([False, False]), nobody) == []
