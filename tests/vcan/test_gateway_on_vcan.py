"""A gateway between vcan0, where the sensors are, and vcan1; can-utils plays, makes noise, and records on both."""

from collections.abc import Iterable
from pathlib import Path

from ecu_node.bus.wiring import Mode
from ecu_node.database import VehicleDatabase
from tests.vcan.conftest import STATUS, StartNode
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
from tests.vcan.small_drive import VEHICLE, sent_by_core

INSTANTS = 150
NOISE, BACK = "345", "346"
"""Identifiers of cangen's standard frames towards the vehicle and back; its extended ones are random."""
EXTENDED = "18FF1234"
"""Identifier of the drive's extended frames."""


def apart(frames: Iterable[LoggedFrame]) -> dict[str, list[LoggedFrame]]:
    """Frames by who sends or carries them, each in their order; but for those of the status."""
    found: dict[str, list[LoggedFrame]] = {"branches": [], "others": [], "noise": []}
    for item in frames:
        if item.identifier == NOISE or (len(item.identifier) == 8 and item.identifier != EXTENDED):
            found["noise"].append(item)
        elif item.identifier not in {f"{STATUS:03X}", BACK}:
            found["branches" if item.identifier in {"110", "120", "130"} else "others"].append(item)
    return found


def test_gateway_changes_currents_and_crcs_and_nothing_else(
    database: VehicleDatabase, drive: Path, start_gateway: StartNode, here: Recording, there: Recording
) -> None:
    with start_gateway("--vehicle", VEHICLE, "--fd") as node:
        with playing(drive) as player:
            generate(CHANNEL, 150, "-I", NOISE, "-m")
            generate(CHANNEL, 50, "-e")
            generate(OTHER_CHANNEL, 50, "-I", BACK)
            generate(OTHER_CHANNEL, 10, "-I", BACK, "-R")
            assert player.wait() == 0
        total = len(frames_of(drive)) + 260
        sent = here.wait_for_frames(total)
        held_back = INSTANTS // 10
        arrived_at_least = total - held_back
        wait_until(
            lambda: sum(item.identifier != f"{STATUS:03X}" for item in there.frames) >= arrived_at_least,
            "all frames on the other bus",
        )
        assert node.stop() == 0
    before, after = apart(sent), apart(there.frames)
    assert len(before["noise"]) == 200
    assert any(item.data.startswith("#") for item in before["noise"]), "FD frames, too"
    assert (after["noise"], after["others"]) == (before["noise"], before["others"])
    assert after["branches"] == sent_by_core(database, Mode.GATEWAY, before["branches"])
    assert after["branches"] != before["branches"]
    back = [[item for item in side.frames if item.identifier == BACK] for side in (here, there)]
    assert len(back[0]) == 60
    assert back[0] == back[1]
    assert here.frames == sent, "nothing comes back, and the status stays where it belongs"
    counted = f"forwarded {len(after['branches'])}, held back {held_back}, corrupt {held_back}"
    assert node.messages.endswith(f"{counted}\n")
