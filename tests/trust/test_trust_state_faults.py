"""States that must not come about, and what power cuts leave in the audit log."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.audit import broken_line
from ecu_node.trust.state import audit_path, read_state, signed_parameters, write_state
from tests.trust.damage import cut
from tests.trust.signing import Signers

DAY = timedelta(days=1)


def test_a_damaged_slot_in_force_does_not_keep_new_parameters_out(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    cut(two_slots / "slot-b.json")
    now = datetime.now(UTC)
    accept(two_slots, signers.parameters(parameters, 7, not_before=now - DAY), "f", database, now)
    found = conclude(two_slots, 7, passed=True, text="seen", now=now)
    assert found.in_force == "a"
    assert signed_parameters(two_slots, found, "a").sequence == 7


def test_a_set_that_was_never_tried_does_not_come_in_force_by_a_revocation(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    now = datetime.now(UTC)

    def take(content: bytes) -> None:
        accept(two_slots, content, "f", database, now)

    take(signers.revocation(7, 5, 6))
    take(signers.parameters(parameters, 8, not_before=now - DAY))
    take(signers.parameters(parameters, 9, not_before=now - DAY))
    take(signers.revocation(10, 3))
    found = read_state(two_slots)
    assert (found.in_force, [slot.sequence for slot in found.slots.values()]) == (None, [9])


def test_a_trial_that_another_one_has_replaced_leaves_nothing_that_was_never_tried(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    now = datetime.now(UTC)
    for content in (
        signers.parameters(parameters, 7, not_before=now - DAY),
        signers.revocation(8, 6),
        signers.parameters(parameters, 9, not_before=now - DAY),
        signers.revocation(10, 3),
    ):
        accept(two_slots, content, "f", database, now)
    found = read_state(two_slots)
    assert (found.in_force, [slot.sequence for slot in found.slots.values()]) == (None, [9])


def test_a_number_that_was_revoked_before_it_came_is_refused(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    now = datetime.now(UTC)
    accept(two_slots, signers.revocation(7, 8), "f", database, now)
    with pytest.raises(TrustError, match="number 8 was revoked") as caught:
        accept(two_slots, signers.parameters(parameters, 8, not_before=now - DAY), "f", database, now)
    assert caught.value.reason is Reason.REVOKED


def test_two_power_cuts_in_the_audit_log_are_no_change_and_a_change_beside_them_is(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    path, now = audit_path(two_slots), datetime.now(UTC)
    whole = path.read_bytes()

    def refuse() -> bytes:
        with pytest.raises(UserError):
            accept(two_slots, b"{}\n", "f", database, now)
        return path.read_bytes()

    once = refuse()[: len(whole) + 100]
    path.write_bytes(once)
    assert broken_line(path) is None, "a line that is cut off at the end"
    twice = refuse()[: len(once) + 120]
    path.write_bytes(twice)
    assert broken_line(path) is None
    full = refuse()
    assert broken_line(path) is None
    lines = full.splitlines()
    path.write_bytes(b"\n".join([*lines[:-4], *lines[-3:]]) + b"\n")
    assert broken_line(path) is not None, "the last whole line before the cut is missing"


def test_a_state_that_speaks_of_slots_that_are_not_there_is_refused(two_slots: Path) -> None:
    found = read_state(two_slots)
    for wrong in (replace(found, on_trial="b"), replace(found, slots={}), replace(found, in_force="a", on_trial="a")):
        write_state(two_slots, wrong)
        with pytest.raises(TrustError, match="slots in force and on trial do not go together"):
            read_state(two_slots)
    write_state(two_slots, replace(found, keys=replace(found.keys, threshold=9)))
    with pytest.raises(TrustError, match="9 signers are needed"):
        read_state(two_slots)
    write_state(two_slots, replace(found, newest="2026-06-31T00:00:00Z"))
    with pytest.raises(TrustError, match="is no time"):
        read_state(two_slots)
    write_state(two_slots, found)
    path = two_slots / "state.json"
    path.write_bytes(path.read_bytes() + b"\n")
    with pytest.raises(TrustError, match="not canonical JSON"):
        read_state(two_slots)


def test_no_bit_of_the_state_can_be_another_one(two_slots: Path) -> None:
    path = two_slots / "state.json"
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        with pytest.raises(TrustError, match="not the state of a vehicle: "):
            read_state(two_slots)
    path.write_bytes(whole)
    assert read_state(two_slots).in_force == "b"
