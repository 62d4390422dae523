"""One line for each mistake, whatever a name or a file is made of; and what a node says of revocations."""

import errno
import os
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.bus.service import Log
from ecu_node.cli import main
from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters
from ecu_node.trust import storage
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.canonical import canonical_bytes
from ecu_node.trust.state import read_state
from ecu_node.trust.storage import locked
from tests.trust.signing import Run, Signers, on
from tests.trust.test_trust_running_store import Running

DAY = timedelta(days=1)


@pytest.mark.parametrize("vehicle", [b"a\nb", b"V\xff", b"v\x1b[2J"])
def test_an_identity_that_is_no_text_is_refused_and_leaves_nothing(
    vehicle: bytes, signers: Signers, tmp_path: Path
) -> None:
    (tmp_path / "keys.json").write_bytes(canonical_bytes(signers.keys()) + b"\n")
    command: list[str | bytes] = [sys.executable, "-m", "ecu_node", "provision", "--vehicle", vehicle]
    command += ["--keys", str(tmp_path / "keys.json"), "--state", str(tmp_path / "state")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert "argument --vehicle: " in line
    assert line.isprintable()
    assert not (tmp_path / "state").exists()


def test_the_length_of_a_long_identity_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["provision", "--vehicle", "v" * 300, "--keys", "k", "--state", str(tmp_path / "state")])
    assert "at most 64 characters, found 300 characters" in capsys.readouterr().err


def test_a_line_end_in_the_name_of_a_file_breaks_no_line(
    in_force: Path, params: Path, tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a\nb\x1b[2J.json"
    for command in (["activate", path, *on(in_force)], ["inspect", path], ["inspect", tmp_path / "no\nfolder"]):
        code, out, err = run(*command)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert err[:-1].isprintable()
    Log().say("a\nb")
    assert capsys.readouterr().err == "ecu-node: a\\nb\n"
    code, out, _ = run("check", "--params", path, "--layout", on(in_force)[-1])
    assert code == 1
    assert "a\\nb\\x1b[2J.json: no such parameter file" in out.splitlines()[0]


def test_a_clock_before_1970_is_told(
    in_force: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    clock = datetime(1960, 1, 1, tzinfo=UTC)
    with pytest.raises(TrustError, match="now it is 1960-01-01T00:00:00Z; is the clock set"):
        accept(in_force, signers.parameters(parameters, 6), "f", database, clock)
    running = Running(in_force, database, now=lambda: clock)
    assert running.corrector.reason is Reason.NOT_VALID_NOW


def test_a_disk_that_must_not_be_written_is_not_taken_for_another_folder(
    in_force: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_only(*_: object) -> int:
        raise OSError(30, os.strerror(30))

    def no_locks(*_: object) -> None:  # as a folder of another machine
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    with pytest.raises(UserError, match="name a folder made by 'ecu-node provision'"), locked(in_force / "none"):
        pass
    with monkeypatch.context() as without_locks:
        without_locks.setattr("ecu_node.trust.storage.fcntl.flock", no_locks)
        with pytest.raises(UserError, match=r"cannot be used as state: No locks available$"), locked(in_force):
            pass
    monkeypatch.setattr(storage, "_open", read_only)
    with pytest.raises(UserError, match=r"cannot be used as state: Read-only file system$"), locked(in_force):
        pass


def other(parameters: VehicleParameters, drift: float) -> VehicleParameters:
    battery = replace(parameters.branches["battery"], drift=drift)
    return replace(parameters, branches={**parameters.branches, "battery": battery})


def test_every_revocation_is_told_with_what_is_in_force(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    running, now = Running(two_slots, database), datetime.now(UTC)

    def said_after(content: bytes, now_s: float) -> list[str]:
        accept(two_slots, content, "f", database, now)
        running.said.clear()
        running.store.look(running.corrector, now_s)
        running.store.look(running.corrector, now_s + 2.0)
        return running.said

    assert said_after(signers.revocation(7, 6), 2.0) == [
        "number 6 was revoked; number 5 is in force",
        "number 5: parameter set 300 of vehicle v1 is in force",
    ], "the content of both is the same"
    said_after(signers.parameters(parameters, 8, not_before=now - DAY), 6.0)
    assert said_after(signers.revocation(9, 8), 10.0) == ["number 8 was revoked; number 5 is in force"], "on trial"
    said = said_after(signers.revocation(10, 5), 14.0)
    assert said[0] == "number 5 was revoked; nothing is in force"
    assert [line.partition(": ")[0] for line in said[1:]] == ["passing measured values through"]
    assert Running(two_slots, database).said == []


def test_a_set_that_passes_with_unchanged_content_is_told(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    running, now = Running(two_slots, database), datetime.now(UTC)
    accept(two_slots, signers.parameters(parameters, 7, not_before=now - DAY), "f", database, now)
    conclude(two_slots, 7, passed=True, text="seen", now=now)
    running.store.look(running.corrector, 2.0)
    assert running.said == ["number 7: parameter set 300 of vehicle v1 is in force"]
    assert running.corrector.counters.reloads == 0


def test_a_trial_that_is_replaced_just_now_is_no_alarm(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase, tmp_path: Path
) -> None:
    """The node sees the state of one activation and the slot of another."""
    now = datetime.now(UTC)
    accept(two_slots, signers.parameters(other(parameters, 0.06), 7, not_before=now - DAY), "f", database, now)
    shutil.copyfile(two_slots / "slot-a.json", tmp_path / "old")
    accept(two_slots, signers.parameters(other(parameters, 0.07), 8, not_before=now - DAY), "f", database, now)
    shutil.copyfile(two_slots / "slot-a.json", tmp_path / "new")
    shutil.copyfile(tmp_path / "old", two_slots / "slot-a.json")
    running = Running(two_slots, database)
    for now_s in (0.0, 1.0, 2.0):
        running.store.look(running.corrector, now_s)
    assert running.said == []
    shutil.copyfile(tmp_path / "new", two_slots / "slot-a.json")
    for now_s in (3.0, 4.0):
        running.store.look(running.corrector, now_s)
    assert running.said == ["number 8 is on trial: parameter set 300"]


def test_a_trial_that_was_changed_by_somebody_is_told_soon(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    now = datetime.now(UTC)
    accept(two_slots, signers.parameters(other(parameters, 0.06), 7, not_before=now - DAY), "f", database, now)
    (two_slots / "slot-a.json").write_bytes(b"{}")
    running = Running(two_slots, database)
    for now_s in range(20):
        running.store.look(running.corrector, float(now_s))
    (line,) = running.said
    assert line == f"no trial yet: {two_slots}/slot-a.json: not what was accepted; activate parameters anew"


def test_a_state_that_is_replaced_together_with_its_slot_stays_in_force_until_both_are_read(
    two_slots: Path, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, before = Running(two_slots, database), read_state(two_slots)
    state_file = (two_slots / "state.json").read_bytes()
    (two_slots / "slot-b.json").write_bytes(b"{}")
    with monkeypatch.context() as between:
        between.setattr("ecu_node.trust.parameter_store.read_state", lambda _: _changed(two_slots, state_file, before))
        assert not running.store.look(running.corrector, 2.0, asked=True)
    assert (running.corrector.reason, running.said) == (Reason.NONE, [])
    assert running.store.look(running.corrector, 4.0), "nobody changes it any more, and it is wrong"
    assert running.corrector.reason is Reason.NOT_SIGNED


def _changed(folder: Path, content: bytes, before: object) -> object:
    """What was read, after which a command writes the state anew."""
    (folder / "new").write_bytes(content)
    (folder / "new").replace(folder / "state.json")
    return before
