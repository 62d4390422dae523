"""A node whose state is damaged, missing or another vehicle's: it passes measured values on, says why, and goes on."""

import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import can
import pytest

from ecu_node.bus.service import Requests
from ecu_node.cli import main
from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import LAYOUT, decoded, protected
from tests.trust.damage import a_folder, a_loop, a_pipe, cut, huge, with_text, without, zeros

DAY = timedelta(days=1)
CURRENT_A, DRIFT, OFFSET_A = 100.0, 0.05, 2.0
LONGEST_WAIT_S = 20.0


@dataclass
class Seen:
    """What the rest of the vehicle sees of a node."""

    currents_a: list[float] = field(default_factory=list)
    qualities: set[int] = field(default_factory=set)
    told: tuple[int, int] = (-1, -1)
    """State and reason."""
    exit_code: int = -1
    said: list[str] = field(default_factory=list)


def drive(bus: can.BusABC, database: VehicleDatabase, seen: Seen, done: threading.Event) -> None:
    """Send currents until the node has answered some, and told how it is after them."""
    try:
        give_up = datetime.now(UTC) + timedelta(seconds=LONGEST_WAIT_S)
        for k in range(1_000_000):
            motor = protected(database, "HV_Motor", k % 15, MotorCurrent=93.3 + 0.1 * (k % 2))
            battery = protected(database, "HV_Battery", k % 15, BatteryCurrent=CURRENT_A)
            bus.send(can.Message(arbitration_id=0x120, is_extended_id=False, data=motor))
            bus.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=battery))
            message = bus.recv(0.01)
            while message is not None:
                if message.arbitration_id == 0x510:
                    found = decoded(database, "HV_BatteryCorrected", bytes(message.data))
                    seen.currents_a.append(found["BatteryCurrentCorrected"])
                    seen.qualities.add(found["BatteryCurrentQuality"])
                elif message.arbitration_id == 0x5F0 and len(seen.currents_a) > 5:
                    found = decoded(database, "HV_CorrectionStatus", bytes(message.data))
                    seen.told = found["State"], found["Reason"]
                    if found["State"] != State.STARTING:
                        return
                message = bus.recv(0.0)
            assert datetime.now(UTC) < give_up, "the node does not answer"
    finally:
        done.set()


@pytest.fixture
def node(
    database: VehicleDatabase,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> Callable[..., Seen]:
    """``ecu-node run --state`` on the virtual bus, with the rest of the vehicle in a thread beside it."""

    def run(state: Path, *more: str) -> Seen:
        done, seen, channel = threading.Event(), Seen(), request.node.name
        monkeypatch.setattr(Requests, "stop", lambda self: done.is_set())
        options = ["--state", str(state), "--layout", str(LAYOUT), "--interface", "virtual", "--channel", channel]
        with handlers_kept(), can.Bus(interface="virtual", channel=channel) as bus, ThreadPoolExecutor(1) as pool:
            driving = pool.submit(drive, bus, database, seen, done)
            seen.exit_code = main(["run", *options, *more])
            driving.result(LONGEST_WAIT_S)
        seen.said = capsys.readouterr().err.splitlines()
        return seen

    return run


@contextmanager
def handlers_kept() -> Iterator[None]:
    """What a node does with signals ends with it."""
    import signal  # noqa: PLC0415

    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def require_passed_on(seen: Seen, reason: Reason, words: str) -> None:
    assert seen.exit_code == 0
    assert seen.currents_a == pytest.approx([CURRENT_A] * len(seen.currents_a), abs=0.02)
    assert seen.qualities == {Quality.PASSED_THROUGH}
    assert seen.told == (State.PASSING_THROUGH, reason)
    (line,) = [line for line in seen.said if "passing measured values through" in line]
    assert words in line
    assert not any("Traceback" in line for line in seen.said)


def test_a_whole_state_is_corrected_with(two_slots: Path, node: Callable[..., Seen]) -> None:
    seen = node(two_slots)
    assert seen.told == (State.CORRECTING, Reason.NONE)
    assert seen.currents_a[-1] == pytest.approx((CURRENT_A - OFFSET_A) / (1.0 + DRIFT), abs=0.02)


DAMAGED = "not the state of a vehicle"
CHANGED = f"{DAMAGED}: it is not what was written there"
NOT_ACCEPTED = "not what was accepted; activate parameters anew"


@pytest.mark.parametrize(
    ("name", "damage", "reason", "words"),
    [
        ("state.json", without, Reason.NO_PARAMETERS, "make one with 'ecu-node provision'"),
        ("state.json", a_folder, Reason.MALFORMED_PARAMETERS, f"{DAMAGED}: it is a folder"),
        ("state.json", a_pipe, Reason.MALFORMED_PARAMETERS, f"{DAMAGED}: it is a pipe"),
        ("state.json", a_loop, Reason.NO_PARAMETERS, "cannot read the state of the vehicle: Too many levels"),
        ("state.json", lambda path: path.write_bytes(b""), Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", cut, Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", zeros, Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", huge, Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", lambda path: path.write_bytes(b"[]"), Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", with_text(b'"in_force":"b"', b'"in_force":"c"'), Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", with_text(b'"on_trial":null', b'"on_trial":"b"'), Reason.MALFORMED_PARAMETERS, DAMAGED),
        ("state.json", with_text(b'"newest":"2', b'"newest":"x'), Reason.MALFORMED_PARAMETERS, CHANGED),
        ("state.json", with_text(b'"threshold":2', b'"threshold":1'), Reason.MALFORMED_PARAMETERS, CHANGED),
        ("state.json", with_text(b'"in_force":"b"', b'"in_force":"a"'), Reason.MALFORMED_PARAMETERS, CHANGED),
        (
            "state.json",
            with_text(b'"highest_sequence":6', b'"highest_sequence":2'),
            Reason.MALFORMED_PARAMETERS,
            CHANGED,
        ),
        ("slot-b.json", without, Reason.NO_PARAMETERS, "cannot read the file"),
        ("slot-b.json", a_folder, Reason.MALFORMED_PARAMETERS, "it is a folder"),
        ("slot-b.json", cut, Reason.NOT_SIGNED, NOT_ACCEPTED),
        ("slot-b.json", zeros, Reason.NOT_SIGNED, NOT_ACCEPTED),
        ("slot-b.json", huge, Reason.MALFORMED_PARAMETERS, "it is larger than"),
        ("slot-b.json", with_text(b'"payload":"e', b'"payload":"f'), Reason.NOT_SIGNED, NOT_ACCEPTED),
    ],
)
def test_a_damaged_state_is_one_line_and_measured_values_are_passed_on(
    name: str, damage: Callable[[Path], None], reason: Reason, words: str, two_slots: Path, node: Callable[..., Seen]
) -> None:
    damage(two_slots / name)
    require_passed_on(node(two_slots), reason, words)


def test_a_whole_slot_in_the_place_of_another_is_not_used(two_slots: Path, node: Callable[..., Seen]) -> None:
    shutil.copyfile(two_slots / "slot-a.json", two_slots / "slot-b.json")
    require_passed_on(node(two_slots), Reason.NOT_SIGNED, NOT_ACCEPTED)


def test_without_any_state_measured_values_are_passed_on(tmp_path: Path, node: Callable[..., Seen]) -> None:
    require_passed_on(node(tmp_path / "nowhere"), Reason.NO_PARAMETERS, "make one with 'ecu-node provision'")


def test_the_state_of_another_vehicle_is_not_used(two_slots: Path, node: Callable[..., Seen]) -> None:
    seen = node(two_slots, "--vehicle", "v2")
    require_passed_on(seen, Reason.WRONG_VEHICLE, "parameters are for vehicle 'v1', this is 'v2'")
