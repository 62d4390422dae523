"""The node as a process on a real SocketCAN bus, with can-utils playing and recording."""

import signal
from pathlib import Path

import pytest

from ecu_node.bus.wiring import InForce, Mode
from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase
from tests.vcan.conftest import MARKER, STATUS, StartNode, state_of
from tests.vcan.processes import Recording, play
from tests.vcan.small_drive import VEHICLE, sent_by_core, write_drive

CORRECTED = (0x510, 0x520, 0x530)
OWN = {f"{identifier:03X}" for identifier in (*CORRECTED, STATUS, MARKER)}


def test_drive_is_corrected_and_other_frames_are_unchanged(
    database: VehicleDatabase, tmp_path: Path, start_node: StartNode, here: Recording
) -> None:
    drive = write_drive(tmp_path / "drive.log", database, 250)
    expected = sent_by_core(database, Mode.OVERLAY, drive)
    with start_node("--vehicle", VEHICLE) as node:
        play(tmp_path / "drive.log")
        recorded = {identifier: here.wait_for(identifier, 250) for identifier in CORRECTED}
        status = here.wait_for(STATUS, 10)
        assert node.stop() == 0
    for identifier, found in recorded.items():
        assert found == [bytes.fromhex(frame.data) for frame in expected if frame.identifier == f"{identifier:03X}"]
    here.wait_for_marker(MARKER)
    assert [frame for frame in here.frames if frame.identifier not in OWN] == drive
    assert state_of(status[-1]) == (State.CORRECTING, Reason.NONE)
    assert [data[1] & 15 for data in status] == [k % 15 for k in range(len(status))]
    assert node.messages.endswith("ecu-node: ended: frames in 775, answers 750, corrupt 25\n")


def test_measured_values_pass_through_with_unfit_parameters(
    database: VehicleDatabase, params: Path, tmp_path: Path, start_node: StartNode, here: Recording
) -> None:
    drive = write_drive(tmp_path / "drive.log", database, 20)
    expected = sent_by_core(database, Mode.OVERLAY, drive, InForce(parameters=None, reason=Reason.WRONG_VEHICLE))
    with start_node("--vehicle", "v9999") as node:
        play(tmp_path / "drive.log")
        for identifier in CORRECTED:
            wanted = [bytes.fromhex(frame.data) for frame in expected if frame.identifier == f"{identifier:03X}"]
            assert here.wait_for(identifier, 20) == wanted
        (status, *_) = here.wait_for(STATUS, 1)
        assert node.stop() == 0
    assert state_of(status) == (State.PASSING_THROUGH, Reason.WRONG_VEHICLE)
    why = f"{params}: parameters are for vehicle 'v0007', this is 'v9999'"
    assert f"passing measured values through: {why}" in node.messages


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_or_sigint_ends_the_node_within_a_second(start_node: StartNode, how: signal.Signals) -> None:
    with start_node() as node:
        assert node.stop(how, within_s=1.0) == 0
    assert node.messages.splitlines()[-1] == "ecu-node: ended: no frames"


def test_nonexistent_interface_is_reported_in_one_line(tmp_path: Path, start_node: StartNode) -> None:
    words = "nocan0: cannot open the bus: no such interface"
    with pytest.raises(AssertionError, match=words), start_node("--channel", "nocan0"):
        pass  # it does not start
    assert (tmp_path / "node.err").read_text().count("\n") == 1
