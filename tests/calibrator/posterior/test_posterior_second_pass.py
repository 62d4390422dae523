"""Sensors that are not linear are corrected if that is sure enough; where it is unclear which one it is, nothing is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import msgspec
import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.model_decision import JudgedSensor
from calibrator.posterior.model_parameters import finding_notices, tell_sensors
from calibrator.posterior.second_pass import ModelJudge, with_sensor_models
from calibrator.posterior.verdict import Deployment
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings
from calibrator.summaries.moments import DriveSummary
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import (
    BranchParameters,
    FileReference,
    HardwareFault,
    HeldBack,
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
WILD = SensorModelChoice(model="gain by sign", excess=0.4, excess_sd=0.02, log_bayes_factor=30.0)
SUMMARY = DriveSummary(moments=np.ones((1, 4, 4)), noise_a2=np.ones((1, 2)), branches=2, period_s=0.1, bank="plain")
SURE = JudgedSensor(harm=1e-5, drift_sd=0.02, offset_sd_a=0.3, largest_drift=0.2)
Row = Sequence[SensorModelChoice]


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """Branches for which the reference is in doubt."""

    doubtful: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Told:
    """What :func:`with_sensor_models` reads of a posterior."""

    faults: Faults
    identifiable: Array
    health: Doubt


def findings(*choices: Row) -> SensorFindings:
    return SensorFindings(choices=choices, summaries=[SUMMARY] * len(choices), modelled=[None] * len(choices))


def deployment(corrected: Sequence[Sequence[bool]], *verdicts: Verdict) -> Deployment:
    return Deployment(
        np.array(corrected), np.full((len(verdicts), 2), "", "<U20"), verdicts, np.zeros(len(verdicts), bool)
    )


def posterior(
    vehicles: int = 1, *, drift: float = 0.05, offset_a: float = 1.0, moved: bool = True, doubtful: tuple[int, ...] = ()
) -> FleetPosterior:
    shape = (vehicles, 2)
    told = Told(
        faults=Faults(
            hardware_drift=np.zeros(vehicles),
            hardware_offset_a=np.zeros(shape),
            drift=np.full(shape, drift),
            offset_a=np.full(shape, offset_a),
        ),
        identifiable=np.full(shape, moved),
        health=Doubt(doubtful=doubtful),
    )
    return cast("FleetPosterior", told)


def judged(*choices: Row, sensor: JudgedSensor = SURE) -> list[Mapping[int, JudgedSensor]]:
    return [{k: sensor for k, choice in enumerate(row) if choice.model != "linear"} for row in choices]


def judge_of(database: VehicleDatabase, *, temperature: bool = True) -> ModelJudge:
    layout = database.layout if temperature else msgspec.structs.replace(database.layout, temperature=None)
    return ModelJudge(layout=layout, harm_limit=1e-3)


def parameters(verdict: Verdict, drift: float = 0.05, held_back: HeldBack | None = None) -> VehicleParameters:
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
        branches={"battery": msgspec.structs.replace(branch, held_back=held_back), "motor": branch},
        hardware_fault=HardwareFault(suspected=False),
        deciding_evidence="as before",
        junction_residual=JunctionResidual(measured_a=1.0, corrected_a=1.0),
        provenance=Provenance(tool="t", method="m", created="c", fleet="f", fleet_size=1, drives=["d"], duration_s=1.0),
    )


def test_linear_sensors_change_neither_decision_nor_parameters(database: VehicleDatabase) -> None:
    before = deployment([[True, False], [False, False]], "corrected", "no sensor fault")
    after = with_sensor_models(
        before, posterior(2), findings([LINEAR, LINEAR], [LINEAR, LINEAR]), [{}, {}], judge_of(database)
    )
    assert after.corrected.tolist() == before.corrected.tolist()
    assert after.verdicts == before.verdicts
    assert tell_sensors(parameters("corrected"), [LINEAR, LINEAR], {}) == parameters("corrected")


@pytest.mark.parametrize("corrected", [[True, True], [True, False], [False, False]])
@pytest.mark.parametrize("model", [BY_SIGN, WARM])
def test_a_sure_model_is_corrected_whatever_its_linear_part_and_the_other_branch_is_as_it_was(
    corrected: list[bool], model: SensorModelChoice, database: VehicleDatabase
) -> None:
    before = deployment([corrected], "corrected" if any(corrected) else "no sensor fault")
    row = [model, LINEAR]
    decision = with_sensor_models(before, posterior(), findings(row), judged(row), judge_of(database))
    assert decision.corrected.tolist() == [[True, corrected[1]]]
    assert decision.held_back.tolist() == [["", ""]]
    assert decision.verdicts == ("corrected",)


@pytest.mark.parametrize(
    ("model", "judgement", "found", "reason"),
    [
        (BY_SIGN, replace(SURE, harm=0.002), posterior(), "harm limit"),
        (BY_SIGN, replace(SURE, largest_drift=0.5), posterior(), "beyond the limits"),
        (BY_SIGN, SURE, posterior(offset_a=200.0), "beyond the limits"),
        (BY_SIGN, replace(SURE, harm=0.002), posterior(moved=False), "moved too little"),
        (BY_SIGN, SURE, posterior(moved=False, doubtful=(0,)), "reference in doubt"),
        (WILD, SURE, posterior(drift=0.3), "not linear"),
    ],
)
def test_a_model_that_is_not_sure_is_held_back_with_the_reason_that_weighs_most(
    model: SensorModelChoice, judgement: JudgedSensor, found: FleetPosterior, reason: str, database: VehicleDatabase
) -> None:
    row = [model, LINEAR]
    decision = with_sensor_models(
        deployment([[True, False]], "corrected"),
        found,
        findings(row),
        judged(row, sensor=judgement),
        judge_of(database),
    )
    assert decision.corrected.tolist() == [[False, False]]
    assert decision.held_back.tolist() == [[reason, ""]]
    assert decision.verdicts == ("cannot tell",)


def test_without_a_temperature_in_the_layout_a_drift_with_it_is_held_back_and_a_gain_by_sign_is_not(
    database: VehicleDatabase,
) -> None:
    row, judge = [WARM, BY_SIGN], judge_of(database, temperature=False)
    before = deployment([[False, False]], "cannot tell")
    decision = with_sensor_models(before, posterior(), findings(row), judged(row), judge)
    assert decision.corrected.tolist() == [[False, True]]
    assert decision.held_back.tolist() == [["no temperature", ""]]
    told = tell_sensors(parameters("corrected", held_back="no temperature"), row, judged(row)[0])
    assert told.deciding_evidence == (
        "the battery sensor (temperature) cannot be corrected without its temperature: name the temperature of the "
        "sensors in the layout, and calibrate anew"
    )


def test_no_branch_of_a_vehicle_with_an_undecided_sensor_is_corrected_and_other_vehicles_are(
    database: VehicleDatabase,
) -> None:
    before = deployment([[True, True], [True, True]], "corrected", "corrected")
    found = findings([UNDECIDED, BY_SIGN], [LINEAR, LINEAR])
    decision = with_sensor_models(before, posterior(2), found, judged(*found.choices), judge_of(database))
    assert decision.corrected.tolist() == [[False, False], [True, True]]
    assert decision.held_back.tolist() == [["not linear", "not linear"], ["", ""]]
    assert decision.verdicts == ("cannot tell", "corrected")


def test_a_gain_by_sign_is_told_with_the_mean_of_both_gains_and_its_probability_of_harm() -> None:
    told = tell_sensors(parameters("corrected"), [BY_SIGN, LINEAR], {0: SURE})
    branch = told.branches["battery"]
    assert isinstance(branch.sensor_model, GainBySign)
    assert branch.sensor_model.drift_negative == pytest.approx(0.05)
    assert branch.sensor_model.drift_positive == pytest.approx(1.05 / 0.9 - 1.0)
    assert branch.drift == pytest.approx(0.5 * (0.05 + 1.05 / 0.9 - 1.0))
    assert (branch.harm_probability, branch.drift_sd, branch.offset_sd_a) == (1e-5, 0.02, 0.3)
    assert branch.fault_probability == pytest.approx(1.0)
    assert told.branches["motor"] == parameters("corrected").branches["motor"]


def test_a_drift_with_temperature_keeps_the_drift_at_its_reference() -> None:
    branch = tell_sensors(parameters("corrected"), [LINEAR, WARM], {1: SURE}).branches["motor"]
    assert isinstance(branch.sensor_model, TemperatureDrift)
    assert branch.sensor_model.drift_per_k == pytest.approx(0.002 * 1.05)
    assert branch.sensor_model.reference_c == pytest.approx(30.0)
    assert (branch.drift, branch.drift_sd) == (0.05, 0.02)


def test_where_the_reference_is_in_doubt_no_probability_is_told() -> None:
    before = parameters("cannot tell")
    doubtful = msgspec.structs.replace(before.branches["battery"], fault_probability=None, harm_probability=None)
    told = tell_sensors(
        msgspec.structs.replace(before, branches={**before.branches, "battery": doubtful}), [BY_SIGN, LINEAR], {0: SURE}
    )
    assert (told.branches["battery"].fault_probability, told.branches["battery"].harm_probability) == (None, None)


def test_an_undecided_vehicle_names_the_branches_and_has_no_confidence() -> None:
    told = tell_sensors(parameters("cannot tell"), [UNDECIDED, UNDECIDED], {})
    assert told.confidence is None
    assert "battery or motor" in told.deciding_evidence
    assert all(branch.sensor_model is None for branch in told.branches.values())


def test_a_sensor_that_a_parameter_file_cannot_say_keeps_its_linear_part() -> None:
    before = parameters("cannot tell", drift=0.3, held_back="not linear")
    told = tell_sensors(before, [WILD, LINEAR], {0: SURE})
    assert told.branches == before.branches
    assert told.deciding_evidence.endswith("is off by more than a parameter file can say; replace the sensor")


def test_a_corrected_sensor_leaves_the_deciding_evidence_as_it_was() -> None:
    assert tell_sensors(parameters("corrected"), [BY_SIGN, LINEAR], {0: SURE}).deciding_evidence == "as before"


@pytest.mark.parametrize(
    ("held_back", "advice"),
    [("harm limit", "record more drives"), ("beyond the limits", "20.0% and +1.0 A, beyond the limits of f")],
)
def test_a_sensor_that_is_held_back_is_named_with_what_would_decide(held_back: HeldBack, advice: str) -> None:
    told = tell_sensors(parameters("cannot tell", held_back=held_back), [BY_SIGN, LINEAR], {0: SURE})
    assert told.deciding_evidence.startswith("the battery sensor (gain by sign) is ")
    assert advice in told.deciding_evidence


def test_notices_name_each_vehicle_concerned_once() -> None:
    found = findings([BY_SIGN, LINEAR], [LINEAR, LINEAR], [UNDECIDED, UNDECIDED])
    notices = finding_notices(["V1", "V2", "V3"], found, BRANCHES)
    assert [notice.split(":")[0] for notice in notices] == ["vehicle V1", "vehicle V3"]
