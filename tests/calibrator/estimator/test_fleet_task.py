"""What a fleet's task does with bench readings: those that the drives contradict are found, by vehicle and sensor."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from calibrator.estimator.fleet_estimate import estimate_vehicles, learn_fleet
from calibrator.estimator.fleet_task import _contradicted
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
