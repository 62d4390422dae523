"""A gateway between vcan0, where the sensors are, and vcan1; can-utils plays, makes noise, and records on both."""

from collections.abc import Iterable
from pathlib import Path

from ecu_node.database import VehicleDatabase
from tests.vcan.conftest import StartNode
from tests.vcan.processes import (
    CHANNEL,
    OTHER_CHANNEL,
    LoggedFrame,
    Recording,
    frames_of,
    generate,
    playing,
    wait_until,
)
from tests.vcan.small_drive import VEHICLE, passed_on

INSTANTS = 150
STATUS = "5F0"
NOISE = "345"
"""Identifier of cangen's standard frames; its extended ones are random."""
EXTENDED = "18FF1234"
"""Identifier of the drive's extended frames."""


def is_noise(item: LoggedFrame) -> bool:
    """Whether cangen sent it."""
    return item.identifier == NOISE or (len(item.identifier) == 8 and item.identifier != EXTENDED)


def noise(frames: Iterable[LoggedFrame]) -> list[LoggedFrame]:
    """Frames of cangen."""
    return [item for item in frames if is_noise(item)]


def drive_of(frames: Iterable[LoggedFrame]) -> list[LoggedFrame]:
    """Frames of canplayer."""
    return [item for item in frames if not is_noise(item) and item.identifier != STATUS]


def by_carrier(frames: Iterable[LoggedFrame]) -> tuple[list[LoggedFrame], list[LoggedFrame]]:
    """Frames of branches, which the node carries, and others, which the kernel does: each in their order."""
    both: tuple[list[LoggedFrame], list[LoggedFrame]] = [], []
    for item in frames:
        both[item.identifier not in {"110", "120", "130"}].append(item)
    return both


def rewritten(database: VehicleDatabase, frames: Iterable[LoggedFrame]) -> list[LoggedFrame]:
    """What must arrive on the other side."""
    found = ((item.identifier, passed_on(database, item.identifier, bytes.fromhex(item.data))) for item in frames)
    return [LoggedFrame(identifier, data.hex().upper()) for identifier, data in found if data is not None]


def test_gateway_changes_currents_and_crcs_and_nothing_else(
    database: VehicleDatabase,
    params: Path,
    drive: Path,
    start_node: StartNode,
    recording: Recording,
    other_recording: Recording,
) -> None:
    with start_node(params, "--vehicle", VEHICLE, "--gateway", OTHER_CHANNEL, "--fd") as node:
        other_recording.wait_for(int(STATUS, 16), 1)
        with playing(drive) as player:
            generate(CHANNEL, 150, "-I", NOISE, "-m")
            generate(CHANNEL, 50, "-e")
            assert player.wait() == 0
        sent = recording.wait_for_frames(len(frames_of(drive)) + 200)
        expected = rewritten(database, drive_of(sent))
        wait_until(
            lambda: (
                len([item for item in other_recording.frames if item.identifier != STATUS])
                >= len(expected) + len(noise(sent))
            ),
            "all frames on the other bus",
        )
        assert node.stop() == 0
    arrived = other_recording.frames
    assert len(noise(sent)) == 200
    assert any(item.data.startswith("#") for item in noise(sent)), "FD frames, too"
    assert noise(arrived) == noise(sent)
    assert by_carrier(drive_of(arrived)) == by_carrier(expected)
    assert expected != drive_of(sent)
    assert recording.frames == sent, "nothing comes back"
    passed = len(by_carrier(expected)[0])
    counted = f"forwarded {passed}, held back {INSTANTS // 10}, corrupt {INSTANTS // 10}"
    assert node.messages.endswith(f"{counted}\n")


def test_frames_towards_the_sensors_all_pass_once(
    params: Path, start_node: StartNode, recording: Recording, other_recording: Recording
) -> None:
    with start_node(params, "--gateway", OTHER_CHANNEL) as node:
        other_recording.wait_for(int(STATUS, 16), 1)
        generate(OTHER_CHANNEL, 100, "-I", NOISE)
        generate(OTHER_CHANNEL, 50, "-e")
        generate(OTHER_CHANNEL, 10, "-I", NOISE, "-R")
        wait_until(lambda: len(recording.frames) >= 160, "all frames on the sensors' bus")
        before = len(other_recording.data_of(int(STATUS, 16)))
        other_recording.wait_for(int(STATUS, 16), before + 3)
        assert node.stop() == 0
    sent = [item for item in other_recording.frames if item.identifier != STATUS]
    assert len(sent) == 160, "nothing comes back"
    assert recording.frames == sent, "and the status stays where it belongs"
