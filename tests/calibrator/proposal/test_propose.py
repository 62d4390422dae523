"""Layouts guessed from a DBC: of the power train of this repository, of invented ones, and of none."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from calibrator.cli import app
from calibrator.doctor.examine import examine
from calibrator.errors import LogError, ProposalError
from calibrator.proposal.propose import Proposal, propose_layout
from calibrator.proposal.toml_text import layout_text
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import DatabaseError
from ecu_node.layout import Layout, read_layout
from tests.calibrator.doctor.artificial_logs import DBC, true_drive, write_layout, write_log

HEAD = 'VERSION ""\nBU_: BMS INV VCU\n'
POWERS = (
    HEAD
    + """BO_ 1 PackStatus: 8 BMS
 SG_ PackCurrent : 0|16@1- (0.1,0) [-1000|1000] "A" VCU
 SG_ PackVoltage : 16|16@1+ (0.1,0) [0|1000] "V" VCU
 SG_ MaxDischargeCurrent : 32|16@1+ (0.1,0) [0|1000] "A" VCU
 SG_ CellVoltageMin : 48|16@1+ (0.001,0) [0|5] "V" VCU
BO_ 2 InverterStatus: 8 INV
 SG_ DcPower : 0|16@1- (0.1,0) [-300|300] "kW" VCU
 SG_ PhaseCurrent : 16|16@1+ (1,0) [0|900] "A" VCU
 SG_ TorqueActual : 32|16@1- (0.1,0) [-500|500] "Nm" VCU
 SG_ TorqueRequest : 48|16@1- (0.1,0) [-500|500] "Nm" VCU
"""
)


def written(proposal: Proposal, path: Path) -> Layout:
    path.write_text(layout_text(proposal, path))
    layout = read_layout(path)
    read_database(layout)
    return layout


def proposed(tmp_path: Path, dbc: str) -> Layout:
    (tmp_path / "a.dbc").write_text(dbc)
    return written(propose_layout(tmp_path / "a.dbc", None, "a"), tmp_path / "a.toml")


def test_the_power_train_of_this_repository_is_found_whole(tmp_path: Path) -> None:
    guessed = written(propose_layout(DBC / "hv_powertrain.dbc", None, "car"), tmp_path / "car.toml")
    by_hand = read_layout(DBC / "hv_powertrain.toml")
    found = {branch.source: (branch.sign, branch.timeout_s) for branch in guessed.branch}
    assert found == {branch.source: (branch.sign, branch.timeout_s) for branch in by_hand.branch}
    assert [(one.corrected, one.quality) for one in sorted(guessed.branch, key=lambda branch: branch.name)] == [
        (one.corrected, one.quality) for one in sorted(by_hand.branch, key=lambda branch: branch.name)
    ]
    signals = {item.signal for item in by_hand.input} - {"HV_Battery.ContactorState"}
    assert {item.signal for item in guessed.input} == signals | {"HV_MotorRear.MotorRearTorque"}
    assert set(by_hand.model_inputs) <= set(guessed.model_inputs)
    assert set(by_hand.fleet_inputs) - set(guessed.fleet_inputs) == {"driving_loss", "recuperation_loss"}


def test_limits_phases_demands_and_cells_are_not_taken_for_currents_and_voltage(tmp_path: Path) -> None:
    layout = proposed(tmp_path, POWERS)
    battery, motor = layout.branch
    assert (battery.name, battery.signal) == ("battery", "PackStatus.PackCurrent")
    assert (motor.name, motor.power, motor.voltage) == ("motor", "InverterStatus.DcPower", "PackStatus.PackVoltage")
    assert {item.name: item.signal for item in layout.input} == {
        "voltage": "PackStatus.PackVoltage",
        "torque": "InverterStatus.TorqueActual",
    }


def test_the_order_of_a_dbc_does_not_matter(tmp_path: Path) -> None:
    head, *messages = POWERS.split("BO_ ")
    turned = head + "".join(f"BO_ {message}" for message in reversed(messages))
    (tmp_path / "1").mkdir()
    one, other = proposed(tmp_path, POWERS), proposed(tmp_path / "1", turned)
    assert (one.branch, one.input) == (other.branch, other.input)


def test_comments_and_names_of_a_dbc_cannot_break_the_file(tmp_path: Path) -> None:
    dbc = f'{POWERS}CM_ SG_ 1 PackCurrent "first\nsecond # sign = 1 \\ and {"long " * 40}";\n'
    layout = proposed(tmp_path, dbc)
    assert layout.branch[0].signal == "PackStatus.PackCurrent"


@pytest.mark.parametrize(
    ("comment", "sign"), [("Discharge positive", 1), ("positive while charge flows", -1), ("Current", 1)]
)
def test_comments_tell_signs(comment: str, sign: int, tmp_path: Path) -> None:
    layout = proposed(tmp_path, f'{POWERS}CM_ SG_ 1 PackCurrent "{comment}";\n')
    assert layout.branch[0].sign == sign


def test_where_nothing_is_found_the_units_looked_for_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(HEAD + 'BO_ 1 M: 8 BMS\n SG_ PackCurrent : 0|16@1- (1,0) [0|0] "Ampere" VCU\n')
    with pytest.raises(ProposalError, match=r"looked for units A, kA, mA; MW, W, kW, mW, with words such as battery"):
        propose_layout(tmp_path / "a.dbc", None, "a")
    with pytest.raises(DatabaseError, match=r"none\.dbc: no such DBC"):
        propose_layout(tmp_path / "none.dbc", None, "a")


def test_powers_without_a_voltage_are_told(tmp_path: Path) -> None:
    dbc = POWERS.replace(' SG_ PackVoltage : 16|16@1+ (0.1,0) [0|1000] "V" VCU\n', "")
    (tmp_path / "a.dbc").write_text(dbc)
    with pytest.raises(ProposalError, match=r"InverterStatus\.DcPower\), but no voltage .* units V, kV, mV"):
        propose_layout(tmp_path / "a.dbc", None, "a")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase) -> Path:
    return write_log(tmp_path_factory.mktemp("log"), true_drive(), database)


def test_with_a_log_only_what_is_in_it_is_proposed_and_nothing_is_wrong_with_it(log: Path, tmp_path: Path) -> None:
    layout = written(propose_layout(DBC / "hv_powertrain.dbc", log, "car"), tmp_path / "car.toml")
    assert layout.branch_names == ("battery", "motor", "auxiliary", "dcdc")
    assert not examine(layout, [log]).has_errors
    assert layout.full_scale_a == 250.0  # twice the 118 A that flow, rounded up


@pytest.mark.parametrize("name", ["battery", "motor"])
def test_signs_are_told_by_the_log_against_the_comments(name: str, log: Path, tmp_path: Path) -> None:
    """In a DBC whose scale of one current is negative, the comment about its sign is wrong."""
    write_layout(tmp_path)
    signal = {"battery": "BatteryCurrent", "motor": "MotorCurrent"}[name]
    dbc = tmp_path / "hv_powertrain.dbc"
    dbc.write_text(dbc.read_text().replace(f"{signal} : 16|16@1- (0.02,0)", f"{signal} : 16|16@1- (-0.02,0)"))
    right = propose_layout(DBC / "hv_powertrain.dbc", log, "car").signs
    found = propose_layout(dbc, log, "car").signs
    assert {branch: sign.sign * right[branch].sign for branch, sign in found.items()} == {
        branch: -1 if branch == name else 1 for branch in found
    }


def test_a_log_of_another_vehicle_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.log").write_text("(1.000000) can0 7FF#00\n")
    with pytest.raises(LogError, match="none of its identifiers is in"):
        propose_layout(DBC / "hv_powertrain.dbc", tmp_path / "other.log", "car")


def test_dbc_and_log_in_the_wrong_order_are_told(tmp_path: Path) -> None:
    with pytest.raises(
        ProposalError, match=r"drive\.log\.gz: a log, and .*\.dbc is none; the DBC comes first, the log"
    ):
        CliRunner().invoke(
            app,
            ["layout", "init", str(tmp_path / "drive.log.gz"), "--log", str(DBC / "hv_powertrain.dbc")],
            catch_exceptions=False,
        )


def test_the_command_prints_or_writes_and_never_overwrites(tmp_path: Path) -> None:
    dbc, out = str(DBC / "hv_powertrain.dbc"), tmp_path / "new" / "my car.toml"
    printed = CliRunner().invoke(app, ["layout", "init", dbc])
    assert printed.exit_code == 0
    assert all(len(line) <= 80 for line in printed.stdout.splitlines())
    wrote = CliRunner().invoke(app, ["layout", "init", dbc, "--out", str(out)])
    assert wrote.exit_code == 0
    assert read_layout(out).name == "my_car"
    before = out.read_bytes()
    with pytest.raises(ProposalError, match="exists, and is not overwritten"):
        CliRunner().invoke(app, ["layout", "init", dbc, "--out", str(out)], catch_exceptions=False)
    assert out.read_bytes() == before
