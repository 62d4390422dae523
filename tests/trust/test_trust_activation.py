"""What a vehicle takes, what it refuses, and that a refusal changes nothing but the audit log."""

import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from ecu_node.core.status import Reason, TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import FileReference, VehicleParameters
from ecu_node.trust.activation import accept, conclude, examine
from ecu_node.trust.audit import AuditEntry, broken_line
from ecu_node.trust.judgement import Accepted
from ecu_node.trust.provision import provision
from ecu_node.trust.state import audit_path, read_slot, read_state, signed_parameters
from tests.ecu_node.vehicles import parameters_for
from tests.trust.signing import NOW, VEHICLE, Signers


def take(state: Path, content: bytes, database: VehicleDatabase) -> Accepted:
    return accept(state, content, "f", database, NOW + timedelta(hours=1))


def activate(state: Path, content: bytes, database: VehicleDatabase) -> None:
    """Take parameters, and let them pass their trial."""
    sequence = take(state, content, database).sequence
    assert sequence is not None
    conclude(state, sequence, passed=True, text="well", now=NOW)


def events(state: Path) -> list[str]:
    return [msgspec.json.decode(line, type=AuditEntry).event for line in audit_path(state).read_bytes().splitlines()]


def files(state: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in state.iterdir() if path.name != "audit.log"}


def test_parameters_go_on_trial_and_then_in_force(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    content = signers.parameters(parameters, 5)
    take(state, content, database)
    found = read_state(state)
    assert (found.in_force, found.on_trial, found.highest_sequence) == (None, "a", 5)
    conclude(state, 5, passed=True, text="well", now=NOW)
    found = read_state(state)
    assert (found.in_force, found.on_trial) == ("a", None)
    assert read_slot(state, found, "a") == content
    assert signed_parameters(state, found, "a").parameters == parameters
    assert events(state) == ["provisioned", "on trial", "in force"]


def test_the_slot_in_force_is_never_written(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    for sequence in (6, 7, 8):
        take(state, signers.parameters(parameters, sequence), database)
        found = read_state(state)
        assert (found.in_force, found.on_trial) == ("a", "b")
        assert found.slots["a"].sequence == 5


def test_a_failed_trial_leaves_what_was_in_force(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    take(state, signers.parameters(parameters, 6), database)
    conclude(state, 6, passed=False, text="no", now=NOW)
    found = read_state(state)
    assert (found.in_force, found.on_trial, list(found.slots), found.highest_sequence) == ("a", None, ["a"], 6)
    assert events(state)[-1] == "failed"


def test_the_end_of_a_trial_that_another_one_has_replaced_changes_nothing(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    take(state, signers.parameters(parameters, 5), database)
    take(state, signers.parameters(parameters, 6), database)
    before = read_state(state)
    assert conclude(state, 5, passed=True, text="well", now=NOW) == before
    assert read_state(state) == before


def refusals(signers: Signers, parameters: VehicleParameters) -> list[tuple[str, bytes, Reason, str]]:
    """What must be refused by a vehicle that has number 5 in force: what it is, the file, reason, words."""
    layout, dbc = parameters.layout, parameters.dbc
    other = "0" * 64
    far = replace(
        parameters, branches={**parameters.branches, "battery": replace(parameters.branches["battery"], drift=0.3)}
    )
    beyond = replace(
        parameters, branches={**parameters.branches, "battery": replace(parameters.branches["battery"], drift=0.9)}
    )
    offset = replace(
        parameters, branches={**parameters.branches, "motor": replace(parameters.branches["motor"], offset_a=300.0)}
    )
    return [
        ("older", signers.parameters(parameters, 4), Reason.REPLAYED, "number 4, and 5 was accepted before"),
        ("same", signers.parameters(parameters, 5), Reason.REPLAYED, "number 5, and 5 was accepted before"),
        (
            "vehicle",
            signers.parameters(replace(parameters, vehicle="v2"), 6),
            Reason.WRONG_VEHICLE,
            "for vehicle 'v2', this is 'v1'",
        ),
        (
            "layout",
            signers.parameters(replace(parameters, layout=replace(layout, sha256=other)), 6),
            Reason.WRONG_LAYOUT,
            "made with layout",
        ),
        (
            "DBC",
            signers.parameters(replace(parameters, dbc=replace(dbc, sha256=other)), 6),
            Reason.WRONG_DBC,
            "made with DBC",
        ),
        (
            "expired",
            signers.parameters(parameters, 6, expires=NOW),
            Reason.NOT_VALID_NOW,
            "expired at 2026-06-01T12:00:00Z",
        ),
        (
            "early",
            signers.parameters(parameters, 6, not_before=NOW + timedelta(days=1)),
            Reason.NOT_VALID_NOW,
            "holds from 2026-06-02",
        ),
        ("step", signers.parameters(far, 6), Reason.IMPLAUSIBLE_PARAMETERS, "sign with --allow-large-step"),
        (
            "drift",
            signers.parameters(beyond, 6, allow_large_step=True),
            Reason.IMPLAUSIBLE_PARAMETERS,
            "beyond the layout's limit",
        ),
        (
            "offset",
            signers.parameters(offset, 6, allow_large_step=True),
            Reason.IMPLAUSIBLE_PARAMETERS,
            "beyond the layout's limit",
        ),
        (
            "expected sum",
            signers.parameters(
                replace(parameters, junction_residual=replace(parameters.junction_residual, expected_a=-151.0)), 6
            ),
            Reason.IMPLAUSIBLE_PARAMETERS,
            "an expected Kirchhoff sum of -151 A is beyond the layout's limit of offsets, 150 A",
        ),
        ("signer", signers.parameters(parameters, 6, by="ad"), Reason.NOT_SIGNED, "which is not trusted here"),
        ("threshold", signers.parameters(parameters, 6, by="a"), Reason.NOT_SIGNED, "2 signers are needed"),
        ("keys", signers.key_set(signers.keys(version=3)), Reason.REPLAYED, "key set 3, and 1 is trusted here"),
        ("revocation", signers.revocation(6, 5, vehicle="v2"), Reason.WRONG_VEHICLE, "for vehicle 'v2'"),
        ("old revocation", signers.revocation(5, 5), Reason.REPLAYED, "number 5, and 5 was accepted before"),
    ]


def test_what_is_refused_is_one_line_and_changes_nothing(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    before = files(state)
    for what, content, reason, words in refusals(signers, parameters):
        with pytest.raises(UnfitError, match=r"^f: [^\n]*$") as caught:
            take(state, content, database)
        assert words in str(caught.value), what
        assert caught.value.reason is reason, what
        assert files(state) == before, what
        assert events(state)[-1] == "refused"
    assert broken_line(audit_path(state)) is None


def test_verifying_writes_nothing_and_says_the_same(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    before = files(state) | {"audit.log": audit_path(state).read_bytes()}
    content = signers.parameters(parameters, 5)
    expected = examine(state, content, "f", database, NOW)
    assert files(state) | {"audit.log": audit_path(state).read_bytes()} == before
    assert take(state, content, database) == expected


def test_a_large_step_needs_the_signers_word(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    far = parameters_for(database, battery=(0.3, 2.0))
    activate(state, signers.parameters(far, 6, allow_large_step=True), database)
    assert read_state(state).slots["b"].sequence == 6


def test_names_from_a_file_stay_within_one_line(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    bad = "x\n\x1b[2Jall is well" + "y" * 100_000
    reference = FileReference(name=bad, sha256="0" * 64)
    battery = parameters.branches["battery"]
    for other in (
        replace(parameters, layout=reference),
        replace(parameters, dbc=reference),
        replace(parameters, branches={bad: battery}),
        replace(parameters, branches={bad: replace(battery, delay_s=99.0)}),
        replace(parameters, branches={bad: battery}, verdict="cannot tell"),
    ):
        with pytest.raises(UnfitError) as caught:
            take(state, signers.parameters(other, 5), database)
        assert str(caught.value).isprintable(), str(caught.value)[:200]
        assert len(str(caught.value)) < 1000


def test_a_clock_that_was_set_back_does_not_bring_back_what_has_expired(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    later = NOW + timedelta(days=30)
    accept(state, signers.parameters(parameters, 5, not_before=later), "f", database, later)
    words = (
        "expired at 2026-06-11T12:00:00Z: the newest file accepted here is of 2026-07-01T12:00:00Z, though the clock"
    )
    with pytest.raises(TrustError, match=words) as caught:
        take(state, signers.parameters(parameters, 6, expires=NOW + timedelta(days=10)), database)
    assert caught.value.reason is Reason.NOT_VALID_NOW


def test_a_revocation_brings_back_what_was_in_force_before(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    activate(state, signers.parameters(parameters, 6), database)
    take(state, signers.revocation(7, 6), database)
    found = read_state(state)
    assert found.in_force is not None
    assert found.slots[found.in_force].sequence == 5
    with pytest.raises(TrustError, match="number 6, and 7 was accepted before"):
        take(state, signers.parameters(parameters, 6), database)
    take(state, signers.revocation(8, 5), database)
    assert read_state(state).in_force is None


def test_a_set_that_never_passed_its_trial_is_no_fallback(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    take(state, signers.parameters(parameters, 6), database)
    take(state, signers.revocation(7, 5), database)
    activate(state, signers.parameters(parameters, 8), database)
    take(state, signers.revocation(9, 8), database)
    assert read_state(state).in_force is None


def test_a_revocation_does_not_put_in_force_what_is_on_trial(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    take(state, signers.parameters(parameters, 6), database)
    take(state, signers.revocation(7, 5), database)
    found = read_state(state)
    assert (found.in_force, found.on_trial) == (None, "b")


def test_a_slot_that_was_changed_is_not_used(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    activate(state, signers.parameters(parameters, 5), database)
    (state / "slot-a.json").write_bytes(signers.parameters(parameters, 6))
    with pytest.raises(TrustError, match="not what was accepted"):
        signed_parameters(state, read_state(state), "a")


def test_a_vehicle_is_provisioned_once(state: Path, signers: Signers) -> None:
    with pytest.raises(TrustError, match="there is a state already"):
        provision(state, VEHICLE, signers.keys(), NOW)


def test_without_a_state_nothing_is_taken(
    tmp_path: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    with pytest.raises(UserError, match="cannot be used as state"):
        take(tmp_path / "nowhere", signers.parameters(parameters, 5), database)
    (tmp_path / "empty").mkdir()
    with pytest.raises(TrustError, match="make one with 'ecu-node provision'"):
        take(tmp_path / "empty", signers.parameters(parameters, 5), database)


def test_a_line_of_the_audit_log_that_is_changed_or_missing_shows(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    for sequence in (5, 6, 7):
        activate(state, signers.parameters(parameters, sequence), database)
    path = audit_path(state)
    lines = path.read_bytes().splitlines()
    assert broken_line(path) is None
    path.write_bytes(b"\n".join([*lines[:2], lines[2].replace(b"well", b"ill!"), *lines[3:]]) + b"\n")
    assert broken_line(path) == 4
    path.write_bytes(b"\n".join([*lines[:2], *lines[3:]]) + b"\n")
    assert broken_line(path) == 3
    path.write_bytes(b"\n".join(lines)[:-10])
    conclude(state, 0, passed=True, text="", now=NOW)
    take(state, signers.parameters(parameters, 8), database)
    assert broken_line(path) is None, "a line that a power cut has cut off is no change"


def test_two_processes_that_take_files_at_once_take_both(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase, tmp_path: Path
) -> None:
    code = (
        "import sys; from pathlib import Path; from ecu_node.trust.storage import locked\n"
        "folder, log = Path(sys.argv[1]), Path(sys.argv[2])\n"
        "for _ in range(200):\n"
        "    with locked(folder):\n"
        "        number = int(log.read_text())\n"
        "        log.write_text(str(number + 1))\n"
    )
    log = tmp_path / "number"
    log.write_text("0")
    processes = [subprocess.Popen([sys.executable, "-c", code, str(state), str(log)]) for _ in range(3)]
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert log.read_text() == "600"
