"""Delays between the branches: how well they are found, and what they cost if they are left in."""

from collections.abc import Sequence
from functools import partial

from calibrator.experiments.delayed_trial import delayed_trial
from calibrator.experiments.judging import Effort, Setting, run_settings
from calibrator.experiments.methods import PERFECT, POSTERIOR, Method, Posterior
from calibrator.experiments.recorded_experiments import recorded_settings
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import RecordedCase
from calibrator.experiments.result import ExperimentResult

__all__ = ["LEFT_IN", "delay_experiment"]

DELAYS_MS = (0.0, 100.0, 200.0, 300.0)
METHODS: Sequence[Method] = (PERFECT, POSTERIOR)
LEFT_IN = Posterior(name="posterior, delays left in")
DEFAULT_EFFORT = Effort()


def delay_experiment(
    *,
    fleet: RecordedFleet,
    delays_ms: Sequence[float] = DELAYS_MS,
    methods: Sequence[Method] = METHODS,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Delays between the branches, through asynchronous frames at 100 Hz; K = 2, S = 80.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips, one per vehicle.
    delays_ms : sequence of float
        Each branch is late by a uniform delay of 0 to this. [ms]
    methods : sequence of Method
        What to compare, with delays estimated and taken out; the default is also run with delays left in.
    effort : Effort
        Repetitions, seed, processes.

    Returns
    -------
    ExperimentResult
        Rows by delay and method.
    """

    def settings(compensate: bool) -> list[Setting]:
        trial = partial(delayed_trial, fleet, RecordedCase(), compensate=compensate)
        return [Setting(x=x, make_trial=partial(trial, delay_max_s=x / 1e3)) for x in delays_ms]

    rows = [
        *run_settings(settings(True), methods, effort, label="delays taken out"),
        *run_settings(settings(False), [LEFT_IN], effort, label="delays left in"),
    ]
    return ExperimentResult(
        name="delay",
        title="Delays between the branches",
        x_label="largest delay [ms]",
        settings=recorded_settings(fleet, effort),
        rows=tuple(sorted(rows, key=lambda row: row.x)),
    )
