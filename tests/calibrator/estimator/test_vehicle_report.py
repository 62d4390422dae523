"""Reports on a vehicle: evidence that would decide, findings in words, evidence in the units of its sensors."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as changed

from calibrator.drive import Array
from calibrator.estimator.evidence import evidence_names
from calibrator.estimator.fleet_estimate import FleetEstimate, reported_evidence
from calibrator.estimator.posterior import Spread
from calibrator.estimator.vehicle_parameters import deciding_evidence
from calibrator.estimator.vehicle_report import explained
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, Explanation, HardwareFault, SensorFinding
from tests.calibrator.estimator.simulated_rows import Errors, random_faults, rows_of
from tests.ecu_node.vehicles import parameters_for

NAMES = ("battery", "motor")
FULL_SCALE_A = 400.0


def of(
    probability: float, *, drift: tuple[float, float] = (0, 0), offset_a: tuple[float, float] = (0, 0)
) -> Explanation:
    """An explanation by faults of the two sensors."""
    drifts, offsets = (dict(zip(NAMES, map(float, values), strict=True)) for values in (drift, offset_a))
    return Explanation(
        probability=probability,
        drift={name: value for name, value in drifts.items() if value},
        offset_a={name: value for name, value in offsets.items() if value},
    )


def estimate(
    *explanations: Explanation, held_back: tuple[str, str] = ("", ""), findings: tuple[SensorFinding, ...] = ()
) -> FleetEstimate:
    """Make the estimate of one vehicle: its most probable explanation."""

    def both(values: dict[str, float]) -> Array:
        return np.array([[values.get(name, 0.0) for name in NAMES]])

    none = np.zeros((1, 2))
    return FleetEstimate(
        drift=both(explanations[0].drift),
        offset_a=both(explanations[0].offset_a),
        drift_sd=np.array([[0.0005, 0.006]]),
        offset_sd_a=np.array([[3.0, 0.5]]),
        fault_probability=none,
        harm_probability=none,
        identifiable=np.ones((1, 2), bool),
        corrected=np.zeros((1, 2), bool),
        held_back=np.array([held_back]),
        hardware_drift=np.zeros(1),
        hardware_offset_a=none,
        hardware_probability=np.zeros(1),
        confidence=np.ones(1),
        verdicts=("cannot tell",),
        explanations=[explanations],
        findings=[findings],
        evidence=np.zeros((1, 3, 10)),
        points=[],
        order=(0, 1),
        full_scale_a=FULL_SCALE_A,
    )


def advice(found: FleetEstimate) -> str:
    return deciding_evidence(found, 0, NAMES, layout="hv.toml")[0]


WINDOW = "a zero-current window (contactors open) would decide: the battery sensor then shows +{:.1f} A or +{:.1f} A"
CHECK = "a check of the {} sensor against a reference would decide: its gain is off by {:+.1f} % or {:+.1f} %"


@pytest.mark.parametrize(("explanations", "held_back", "text"), [
    pytest.param((of(0.6, offset_a=(40, 0)), of(0.4, offset_a=(0, 40))), ("", ""), WINDOW.format(40, 0),
                 id="offset of either sensor"),
    ((of(0.6, drift=(0.1, 0)), of(0.4, drift=(0, -0.2))), ("", ""), CHECK.format("motor", 0, -20)),
    ((of(0.5, drift=(0.1, 0)), of(0.5, drift=(0.1, 0))), ("", ""),
     "the explanations differ in the vehicle, not in its sensors: inspect the hardware"),
    # of a branch that is held back, the explanation that prevents its correction counts, not the second one
    ((of(0.958, drift=(0.1, 0), offset_a=(0, 8)), of(0.04, drift=(0.2, 0), offset_a=(0, 8)),
      of(0.002, drift=(0.1, 0), offset_a=(8, 0))), ("", "harm limit"), WINDOW.format(0, 8)),
    ((of(0.99, drift=(0.1, 0)), of(0.01, drift=(0, 0.1))), ("harm limit", ""), CHECK.format("battery", 10, 0)),
    ((of(1.0, drift=(0.9, 0)),), ("beyond the limits", ""),
     "the battery sensor is off by +90.0 % and +0.0 A, beyond the limits of hv.toml: replace the sensor"),
    ((of(1.0, drift=(0.9, 0)),), ("reference in doubt", ""),
     "bench-checked vehicles would decide: the fleet's reference is in doubt for branch battery"),
])  # fmt: skip
def test_deciding_evidence_is_named_for_each_open_question(
    explanations: tuple[Explanation, ...], held_back: tuple[str, str], text: str
) -> None:
    assert advice(estimate(*explanations, held_back=held_back)).startswith(text)


def test_finding_explains_why_its_branch_is_not_corrected() -> None:
    finding = SensorFinding(branch="motor", cause="clipped", probability=0.98, text="the motor sensor clips at 100 A")
    found = estimate(of(1.0, drift=(0, 0.1)), held_back=("", "does not fit"), findings=(finding,))
    assert advice(found) == "the motor sensor clips at 100 A"
    load = SensorFinding(branch=None, cause="switching", probability=0.9, text="a load is switched")
    assert advice(replace(found, findings=[(load,)])) == "a load is switched"
    assert "a check of the motor sensor would decide" in advice(replace(found, findings=[()]))


def test_explanation_in_words_names_sensors_vehicle_and_findings(database: VehicleDatabase) -> None:
    plain = parameters_for(database, battery=(0.1, 4.0), motor=(0.0, 0.0))
    held = BranchParameters(drift=0.2, drift_sd=0.01, offset_a=0.0, apply=False, held_back="harm limit")
    text = explained(
        changed(
            plain,
            vehicle="V7",
            verdict="corrected",
            confidence=0.97,
            branches={**plain.branches, "motor": held},
            hardware_fault=HardwareFault(suspected=True, drift=-0.06, offset_a={"motor": 2.0}, probability=0.9),
            explanations=[of(0.6, drift=(0.1, 0.2)), Explanation(probability=0.4)],
            findings=[SensorFinding(branch="motor", cause="step", probability=0.8, text="the motor gain stepped")],
            deciding_evidence="a check would decide",
        )
    )
    for part in (
        "V7: corrected (confidence 0.97)",
        "battery: gain error (drift) +10.00 %, offset +4.00 A: corrected",
        "motor: gain error (drift) +20.00 % +- 1.00 %, offset +0.00 A: not corrected\n",
        "\n  motor not corrected, because the correction might do harm\n",
        "differs from its fleet, probability 0.90: hardware: all currents -6.00 %; hardware: motor +2.00 A",
        "0.600  battery sensor: drift +10.00 %; motor sensor: drift +20.00 %",
        "0.400  no fault",
        "0.80  the motor gain stepped",
        "\na check would decide\n",
    ):
        assert part in text


def test_reported_evidence_without_noise_equals_that_of_the_true_faults() -> None:
    faults, scale = random_faults(3, vehicles=10, branches=2, sparsity=50.0), FULL_SCALE_A
    rows = rows_of(faults, noise=0.0, errors=Errors(offset_read=0.001))
    centre = np.zeros(10)
    centre[7] = 2.0 / scale  # a load that no branch measures, in the junction constant
    found: Any = SimpleNamespace(
        drift=faults.drift,
        offset_a=faults.offset_a * scale,
        hardware_drift=faults.hardware_drift,
        hardware_offset_a=faults.hardware_offset_a * scale,
        order=(0, 1),
        full_scale_a=scale,
    )
    spread = Spread(mean=centre, covariance=np.zeros((10, 10)), dispersion=np.ones(2), shared=np.zeros(5))
    value, sd, made = reported_evidence(rows, found, spread).transpose(1, 2, 0)
    names, gain = evidence_names(NAMES), 1.0 + faults.drift.T
    for name, measured, explained_by in zip(names, value, made, strict=True):
        if name.startswith("gain read"):
            assert np.isnan(measured).all()
            continue
        load_a = 2.0 * gain[0] if name == "junction constant" else 0.0
        np.testing.assert_allclose(measured + load_a, explained_by, atol=1e-9)
    np.testing.assert_allclose(value[names.index("slope motor")], gain[1] * (1.0 + faults.hardware_drift))
    np.testing.assert_allclose(value[names.index("offset read motor")], faults.offset_a[:, 1] * scale)
    np.testing.assert_allclose(sd[names.index("slope motor")], 0.002 * value[names.index("slope motor")])
    np.testing.assert_allclose(sd[names.index("offset read battery")], 0.001 * scale)
