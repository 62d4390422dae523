"""
An estimator of your own in the paper's table 1
===============================================

It takes the place of a method, also on recorded drives (``docs/experiments.md``). This one holds every vehicle's
hardware for sound: where the line of simulated over reference current, equation (15) of the paper, is not the fleet's
usual one, it blames the sensor.
"""

import numpy as np
from rich.console import Console

from calibrator.experiments.experiments import EXPERIMENTS, fleet_for
from calibrator.experiments.methods import PERFECT, POSTERIOR
from calibrator.experiments.pages import result_table
from calibrator.experiments.runner import run_experiment
from calibrator.experiments.trial import Estimate, Trial
from calibrator.faults import Faults


class SensorOnly:
    name = "own"

    def estimate(self, trial: Trial) -> Estimate:
        rows = (trial.evidence.slopes, 0.02), (trial.evidence.intercepts_a, 0.02 * trial.full_scale_a)
        away = [(values - np.median(values, axis=0), least) for values, least in rows]
        drift, offset_a = (np.where(abs(deviation) > least, deviation, 0.0) for deviation, least in away)
        sound, changed = np.zeros(len(drift)), (drift != 0.0) | (offset_a != 0.0)
        faults = Faults(hardware_drift=sound, hardware_offset_a=0.0 * drift, drift=drift, offset_a=offset_a)
        return Estimate(faults=faults, hardware=sound > 0.0, corrected=changed, confidence=None, failed=0)


experiment, methods = EXPERIMENTS["classifier"].small(vehicles=200), (PERFECT, POSTERIOR, SensorOnly())
result = run_experiment(experiment, fleet_for(experiment), methods=methods, repetitions=2)
Console(width=100).print(result_table(result))
