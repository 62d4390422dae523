"""The node as a process on a real SocketCAN bus, with can-utils playing and recording."""

import math
import signal
from pathlib import Path

import pytest
from e2e.p01 import e2e_p01_check

from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import decoded
from tests.vcan.conftest import StartNode
from tests.vcan.processes import Recording, frames_of, play
from tests.vcan.small_drive import BRANCHES, VEHICLE, protected, write_drive

INSTANTS = 250
STATUS, MARKER = 0x5F0, 0x7F0
CORRECTED = {"battery": 0x510, "motor": 0x520, "auxiliary": 0x530}


def expected_frame(database: VehicleDatabase, name: str, k: int, code: int, quality: Quality) -> bytes:
    signal_name = BRANCHES[name].signal
    return protected(
        database,
        f"{BRANCHES[name].message}Corrected",
        k,
        **{f"{signal_name}Corrected": code, f"{signal_name}Quality": int(quality)},
    )


def state_and_reason(database: VehicleDatabase, data: bytes) -> tuple[int, int]:
    values = decoded(database, "HV_CorrectionStatus", data)
    return values["State"], values["Reason"]


def kirchhoff_rmse(database: VehicleDatabase, recording: Recording, *, corrected: bool) -> float:
    """Root mean square of the sum of the recorded branch currents over all instants. [A]"""
    suffix = "Corrected" if corrected else ""
    sums = [0.0] * INSTANTS
    for branch in BRANCHES.values():
        message = database.message(branch.message + suffix)
        intact = [
            data for data in recording.data_of(message.frame_id) if e2e_p01_check(bytearray(data), message.frame_id)
        ]
        for k, data in enumerate(intact):
            sums[k] += branch.sign * decoded(database, message.name, data)[branch.signal + suffix]
    return math.sqrt(sum(value * value for value in sums) / INSTANTS)


def test_drive_is_corrected_exactly_and_other_frames_are_unchanged(
    database: VehicleDatabase, params: Path, tmp_path: Path, start_node: StartNode, recording: Recording
) -> None:
    drive = tmp_path / "drive.log"
    measured = write_drive(drive, database, INSTANTS)
    with start_node(params, "--vehicle", VEHICLE) as node:
        play(drive)
        recorded = {name: recording.wait_for(CORRECTED[name], INSTANTS) for name in BRANCHES}
        status = recording.wait_for(STATUS, 10)
        assert node.stop() == 0
    corrected = {name: [BRANCHES[name].corrected_code(code) for code in codes] for name, codes in measured.items()}
    for name in BRANCHES:
        assert recorded[name] == [
            expected_frame(database, name, k, code, Quality.CORRECTED) for k, code in enumerate(corrected[name])
        ]
    own = {f"{identifier:03X}" for identifier in (*CORRECTED.values(), STATUS)}
    recording.wait_for_marker(MARKER)
    own.add(f"{MARKER:03X}")
    assert [frame for frame in recording.frames if frame.identifier not in own] == frames_of(drive)
    assert state_and_reason(database, status[-1]) == (State.CORRECTING, Reason.NONE)
    assert [data[1] & 15 for data in status] == [k % 15 for k in range(len(status))]
    made, damaged = 3 * INSTANTS, INSTANTS // 10
    counted = f"frames in {made + damaged}, answers {made}, corrupt {damaged}"
    assert node.messages.endswith(f"ecu-node: ended: {counted}\n")
    before, after = (kirchhoff_rmse(database, recording, corrected=which) for which in (False, True))
    assert before >= 10.0 * after


def test_measured_values_pass_through_with_unfit_parameters(
    database: VehicleDatabase, params: Path, tmp_path: Path, start_node: StartNode, recording: Recording
) -> None:
    measured = write_drive(tmp_path / "drive.log", database, 20)
    with start_node(params, "--vehicle", "v9999") as node:
        play(tmp_path / "drive.log")
        for name, codes in measured.items():
            assert recording.wait_for(CORRECTED[name], 20) == [
                expected_frame(database, name, k, code, Quality.PASSED_THROUGH) for k, code in enumerate(codes)
            ]
        (status, *_) = recording.wait_for(STATUS, 1)
        assert node.stop() == 0
    assert state_and_reason(database, status) == (State.PASSING_THROUGH, Reason.WRONG_VEHICLE)
    why = f"{params}: parameters are for vehicle 'v0007', this is 'v9999'"
    assert f"passing measured values through: {why}" in node.messages


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_or_sigint_ends_the_node_within_a_second(
    params: Path, start_node: StartNode, how: signal.Signals
) -> None:
    with start_node(params) as node:
        assert node.stop(how, within_s=1.0) == 0
    assert node.messages.splitlines()[-1] == "ecu-node: ended: no frames"


def test_nonexistent_interface_is_reported_in_one_line(params: Path, tmp_path: Path, start_node: StartNode) -> None:
    with pytest.raises(AssertionError, match="nocan0: cannot open the bus: no such interface"):  # noqa: SIM117
        with start_node(params, "--channel", "nocan0"):
            pass
    assert (tmp_path / "node.err").read_text().count("\n") == 1
