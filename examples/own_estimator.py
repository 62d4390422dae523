"""An estimator of your own in the paper's table 1; see docs/experiments.md."""

import numpy as np
from rich.console import Console

from calibrator.drive import Array
from calibrator.experiments.common_drive import builtin_common_drive
from calibrator.experiments.judging import Effort
from calibrator.experiments.methods import PERFECT, POSTERIOR, Estimate
from calibrator.experiments.paper_experiments import classifier_experiment
from calibrator.experiments.table import result_table
from calibrator.experiments.trial import FleetLaw, Trial
from calibrator.faults import Faults


class SensorOnly:
    """Every vehicle is sound, so a line that is not the fleet's usual one is its sensor's fault."""

    name = "own"

    def estimate(self, trial: Trial) -> Estimate:
        """Lines of simulated over reference current (15), against their medians over the fleet."""
        evidence = trial.evidence
        drift = self.apart(evidence.slopes, 0.02)
        offset_a = self.apart(evidence.intercepts_a, 0.02 * trial.full_scale_a)
        sound, changed = np.zeros(len(drift)), (drift != 0.0) | (offset_a != 0.0)
        faults = Faults(hardware_drift=sound, hardware_offset_a=0.0 * drift, drift=drift, offset_a=offset_a)
        return Estimate(faults=faults, hardware=sound > 0.0, corrected=changed, confidence=None, failed=0)

    @staticmethod
    def apart(values: Array, least: float) -> Array:
        """What differs from the fleet's median by more than a least deviation; else 0."""
        deviation = values - np.median(values, axis=0)
        return np.where(abs(deviation) > least, deviation, 0.0)


drive, law, methods = builtin_common_drive(), FleetLaw(vehicles=200), (PERFECT, POSTERIOR, SensorOnly())
table = result_table(classifier_experiment(drive=drive, law=law, methods=methods, effort=Effort(repetitions=2)))
Console().print(table)
