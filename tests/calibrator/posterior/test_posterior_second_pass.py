"""Sensors that are not linear are told and not corrected; where it is unclear which one it is, nothing is corrected."""

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from calibrator.evidence.summary import DriveSummary
from calibrator.posterior.second_pass import finding_notices, tell_sensors, without_sensor_models
from calibrator.posterior.verdict import Deployment
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings
from ecu_node.parameters import (
    BranchParameters,
    FileReference,
    HardwareFault,
    JunctionResidual,
    Provenance,
    VehicleParameters,
    Verdict,
)
from ecu_node.sensor_models import GainBySign, TemperatureDrift

BRANCHES = ("battery", "motor")
LINEAR = SensorModelChoice(log_bayes_factor=-3.0)
UNDECIDED = SensorModelChoice(log_bayes_factor=2.0, undecided=True)
BY_SIGN = SensorModelChoice(model="gain by sign", excess=0.1, excess_sd=0.02, log_bayes_factor=30.0)
WARM = SensorModelChoice(model="temperature", excess=0.002, excess_sd=0.0002, reference=5.0, log_bayes_factor=30.0)
SUMMARY = DriveSummary(moments=np.ones((1, 4, 4)), noise_a2=np.ones((1, 2)), branches=2, period_s=0.1, bank="plain")


def findings(*choices: Sequence[SensorModelChoice]) -> SensorFindings:
    return SensorFindings(choices=choices, summaries=[SUMMARY] * len(choices))


def deployment(corrected: Sequence[Sequence[bool]], *verdicts: Verdict) -> Deployment:
    return Deployment(
        np.array(corrected), np.full((len(verdicts), 2), "", "<U20"), verdicts, np.zeros(len(verdicts), bool)
    )


def parameters(verdict: Verdict, drift: float = 0.05) -> VehicleParameters:
    file = FileReference(name="f", sha256="0" * 64)
    branch = BranchParameters(
        drift=drift, offset_a=1.0, drift_sd=0.01, apply=False, fault_probability=0.2, harm_probability=0.0
    )
    return VehicleParameters(
        vehicle="V1",
        layout=file,
        dbc=file,
        verdict=verdict,
        confidence=0.99,
        branches=dict.fromkeys(BRANCHES, branch),
        hardware_fault=HardwareFault(suspected=False),
        deciding_evidence="as before",
        junction_residual=JunctionResidual(measured_a=1.0, corrected_a=1.0),
        provenance=Provenance(tool="t", method="m", created="c", fleet="f", fleet_size=1, drives=["d"], duration_s=1.0),
    )


def test_linear_sensors_change_neither_decision_nor_parameters() -> None:
    before = deployment([[True, False], [False, False]], "corrected", "no sensor fault")
    after = without_sensor_models(before, findings([LINEAR, LINEAR], [LINEAR, LINEAR]))
    assert after.corrected.tolist() == before.corrected.tolist()
    assert after.verdicts == before.verdicts
    assert tell_sensors(parameters("corrected"), [LINEAR, LINEAR]) == parameters("corrected")


@pytest.mark.parametrize(
    ("corrected", "after", "verdict"),
    [
        ([True, True], [False, True], "corrected"),
        ([True, False], [False, False], "cannot tell"),
        ([False, False], [False, False], "cannot tell"),
    ],
)
def test_a_branch_with_a_sensor_model_is_not_corrected_but_others_are(
    corrected: list[bool], after: list[bool], verdict: Verdict
) -> None:
    before = deployment([corrected], "corrected" if any(corrected) else "no sensor fault")
    decision = without_sensor_models(before, findings([BY_SIGN, LINEAR]))
    assert decision.corrected.tolist() == [after]
    assert decision.held_back.tolist() == [["not linear", ""]]
    assert decision.verdicts == (verdict,)


def test_no_branch_of_a_vehicle_with_an_undecided_sensor_is_corrected_and_other_vehicles_are() -> None:
    before = deployment([[True, True], [True, True]], "corrected", "corrected")
    decision = without_sensor_models(before, findings([UNDECIDED, LINEAR], [LINEAR, LINEAR]))
    assert decision.corrected.tolist() == [[False, False], [True, True]]
    assert decision.held_back.tolist() == [["not linear", "not linear"], ["", ""]]
    assert decision.verdicts == ("cannot tell", "corrected")


def test_a_gain_by_sign_is_told_with_the_mean_of_both_gains_and_no_probability_of_harm() -> None:
    told = tell_sensors(parameters("cannot tell"), [BY_SIGN, LINEAR])
    branch = told.branches["battery"]
    assert isinstance(branch.sensor_model, GainBySign)
    assert branch.sensor_model.drift_negative == pytest.approx(0.05)
    assert branch.sensor_model.drift_positive == pytest.approx(1.05 / 0.9 - 1.0)
    assert branch.drift == pytest.approx(0.5 * (0.05 + 1.05 / 0.9 - 1.0))
    assert branch.harm_probability is None
    assert branch.fault_probability == pytest.approx(1.0)
    assert "battery (gain by sign)" in told.deciding_evidence
    assert told.branches["motor"] == parameters("cannot tell").branches["motor"]


def test_a_drift_with_temperature_keeps_the_drift_at_its_reference() -> None:
    branch = tell_sensors(parameters("cannot tell"), [LINEAR, WARM]).branches["motor"]
    assert isinstance(branch.sensor_model, TemperatureDrift)
    assert branch.sensor_model.drift_per_k == pytest.approx(0.002 * 1.05)
    assert branch.sensor_model.reference_c == pytest.approx(30.0)
    assert (branch.drift, branch.drift_sd) == (0.05, 0.01)


def test_an_undecided_vehicle_names_the_branches_and_has_no_confidence() -> None:
    told = tell_sensors(parameters("cannot tell"), [UNDECIDED, UNDECIDED])
    assert told.confidence is None
    assert "battery or motor" in told.deciding_evidence
    assert all(branch.sensor_model is None for branch in told.branches.values())


def test_a_sensor_that_a_parameter_file_cannot_say_keeps_its_linear_part() -> None:
    wild = SensorModelChoice(model="gain by sign", excess=0.4, excess_sd=0.02, log_bayes_factor=30.0)
    before = parameters("cannot tell", drift=0.3)
    assert tell_sensors(before, [wild, LINEAR]).branches == before.branches


def test_a_corrected_vehicle_keeps_its_deciding_evidence() -> None:
    assert tell_sensors(parameters("corrected"), [BY_SIGN, LINEAR]).deciding_evidence == "as before"


def test_a_corrected_vehicle_with_a_branch_held_back_is_told_that_no_drive_makes_it_linear() -> None:
    before = parameters("corrected")
    motor = msgspec.structs.replace(before.branches["battery"], held_back="not linear")
    held = msgspec.structs.replace(before, branches={**before.branches, "battery": motor})
    assert "battery (gain by sign)" in tell_sensors(held, [BY_SIGN, LINEAR]).deciding_evidence


def test_notices_name_each_vehicle_concerned_once() -> None:
    found = findings([BY_SIGN, LINEAR], [LINEAR, LINEAR], [UNDECIDED, UNDECIDED])
    notices = finding_notices(["V1", "V2", "V3"], found, BRANCHES)
    assert [notice.split(":")[0] for notice in notices] == ["vehicle V1", "vehicle V3"]
