"""The audit log: of any length and any form it takes little memory, holds nobody up, and tells what was changed."""

import hashlib
import json
import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random

import pytest
from msgspec.structs import replace

from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters
from ecu_node.trust import storage
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.audit import REFUSED, End, add_entry, broken_line, end_of_log, event_now, next_entry
from ecu_node.trust.log_lines import lines, lines_from_the_end
from ecu_node.trust.state import audit_path, read_state, write_state
from ecu_node.trust.storage import locked
from tests.trust.damage import a_folder, a_loop, a_pipe, without
from tests.trust.signing import NOW, Run, Signers, on

LITTLE = 1 << 20
MISSING = "lines are missing at its end, or all of it: somebody cut or removed it"


def filled(path: Path, entries: int) -> None:
    """Refusals, one after the other, as a log that nobody shortens has them."""
    for number in range(entries):
        add_entry(path, event_now(REFUSED, f"{number} {'x' * 500}", now=NOW))


def all_but_the_first_line(path: Path) -> None:
    path.write_bytes(path.read_bytes().partition(b"\n")[0] + b"\n")


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_lines_are_the_same_from_either_end(tmp_path: Path) -> None:
    rng, path = Random(1), tmp_path / "log"
    lengths = (0, 0, 1, 10, 8191, 8192, 8193, 20_000)
    for _ in range(100):
        content = b"\n".join(b"x" * rng.choice(lengths) for _ in range(rng.randrange(5))) + rng.choice([b"\n", b""])
        path.write_bytes(content)
        found = list(lines(path))
        assert list(lines_from_the_end(path)) == found[::-1]
        expected = content.removesuffix(b"\n").split(b"\n") if content else []
        assert [line.digest for line in found] == [hashlib.sha256(line).hexdigest() for line in expected]
        assert [line.text for line in found] == [line[:8192] for line in expected]
    assert list(lines(tmp_path / "none")) == list(lines_from_the_end(tmp_path / "none")) == []


def test_an_entry_of_a_long_log_takes_no_more_memory_or_reading_than_of_a_short_one(in_force: Path) -> None:
    path = audit_path(in_force)
    filled(path, 20)
    line = path.read_bytes().splitlines()[-1] + b"\n"
    with path.open("ab") as log:
        log.write(line * 40_000)
    assert path.stat().st_size > 20 * LITTLE
    event = event_now("in force", "x", now=NOW)
    made_by = next_entry(path, event)
    assert end_of_log(path, made_by) is End.LEFT
    assert peak_bytes(lambda: add_entry(path, event)) < LITTLE
    assert peak_bytes(lambda: end_of_log(path, made_by)) < LITTLE
    assert end_of_log(path, made_by) is End.TOLD
    assert peak_bytes(lambda: broken_line(path)) < LITTLE
    assert broken_line(path) is not None, "one line after itself"


@pytest.mark.parametrize("damage", [without, lambda path: os.truncate(path, 0), all_but_the_first_line])
def test_a_log_that_is_missing_or_cut_shows_also_after_the_next_change(
    damage: Callable[[Path], None], two_slots: Path, signers: Signers, database: VehicleDatabase, run: Run
) -> None:
    assert run("inspect", two_slots)[::2] == (0, "")
    damage(audit_path(two_slots))
    code, out, err = run("inspect", two_slots)
    assert (code, out.splitlines()[-1]) == (1, "audit log: lines are missing at its end")
    assert err.splitlines() == [f"ecu-node: {audit_path(two_slots)}: {MISSING}"]
    accept(two_slots, signers.revocation(7, 5), "f", database, datetime.now(UTC))
    code, out, err = run("inspect", two_slots)
    assert (code, len(err.splitlines())) == (1, 1)
    assert "is not what was written there" in err


def test_the_last_change_that_a_power_cut_kept_from_the_log_is_no_alarm(two_slots: Path, run: Run) -> None:
    path = audit_path(two_slots)
    whole = path.read_bytes()
    last = whole[: whole.rindex(b"\n", 0, -1) + 1]
    for content in (last, whole[: len(last) + 20], whole[:-1], last + bytes(20)):
        path.write_bytes(content)
        code, out, err = run("inspect", two_slots)
        assert (code, err) == (0, ""), content[-80:]
        assert ("the next command adds it: in force" in out) == (content != whole[:-1])


def test_a_state_that_does_not_say_what_has_made_it_so_is_used(
    two_slots: Path, signers: Signers, database: VehicleDatabase, run: Run
) -> None:
    """As the key is one that may be left out."""
    write_state(two_slots, replace(read_state(two_slots), made_by=None))
    assert run("inspect", two_slots)[::2] == (0, "")
    accept(two_slots, signers.revocation(7, 6), "f", database, datetime.now(UTC))
    assert run("inspect", two_slots)[::2] == (0, "")


def test_a_log_on_a_disk_that_fails_is_one_line() -> None:
    """The first page of a process cannot be read, as a block of such a disk."""
    with pytest.raises(UserError, match=r"^/proc/self/mem: cannot read the audit log: Input/output error$"):
        list(lines(Path("/proc/self/mem")))


def test_a_refusal_is_kept_with_the_number_that_the_file_gives_itself(
    in_force: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    for content, number in ((signers.parameters(parameters, 3), 3), (signers.revocation(4, 5), 4), (b"{}\n", None)):
        with pytest.raises(UserError):
            accept(in_force, content, "f", database, NOW)
        assert json.loads(audit_path(in_force).read_bytes().splitlines()[-1])["sequence"] == number


def test_a_log_of_zeros_is_no_matter_of_memory(in_force: Path) -> None:
    path = audit_path(in_force)
    os.truncate(path, path.stat().st_size + 200 * LITTLE)
    event = event_now("in force", "x", now=NOW)
    assert peak_bytes(lambda: add_entry(path, event)) < LITTLE
    assert peak_bytes(lambda: broken_line(path)) < LITTLE
    assert broken_line(path) is None, "zeros that a file system left are no change"


@pytest.mark.parametrize("damage", [a_pipe, a_folder, a_loop])
def test_a_log_that_is_none_is_one_line_and_holds_nobody_up(
    damage: Callable[[Path], None],
    in_force: Path,
    signers: Signers,
    parameters: VehicleParameters,
    database: VehicleDatabase,
    tmp_path: Path,
    run: Run,
) -> None:
    before = read_state(in_force)
    damage(audit_path(in_force))
    (tmp_path / "r").write_bytes(signers.revocation(6, 5))
    for command in (["revoke", tmp_path / "r", *on(in_force)], ["inspect", in_force]):
        code, out, err = run(*command)
        assert (code, out, len(err.splitlines())) == (1, "", 1)
        assert f"{audit_path(in_force)}: cannot" in err
    with pytest.raises(UserError, match="audit log"):
        conclude(in_force, 5, passed=True, text="seen", now=NOW)
    assert read_state(in_force) == before


def test_a_lock_that_is_a_pipe_is_one_line(in_force: Path, signers: Signers, tmp_path: Path, run: Run) -> None:
    (in_force / "lock").unlink()
    os.mkfifo(in_force / "lock")
    (tmp_path / "r").write_bytes(signers.revocation(6, 5))
    code, out, err = run("revoke", tmp_path / "r", *on(in_force))
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert "it is no file; remove it" in err


def test_a_process_that_never_ends_does_not_keep_others_waiting_for_ever(
    in_force: Path, signers: Signers, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(storage, "LONGEST_WAIT_S", 0.05)
    with locked(in_force), pytest.raises(UserError, match="another process changes it now; try again"):
        accept(in_force, signers.revocation(6, 5), "f", database, NOW)


def test_a_process_waits_for_another_one_that_is_soon_done(
    in_force: Path, signers: Signers, database: VehicleDatabase
) -> None:
    code = (
        "import sys, time; from pathlib import Path; from ecu_node.trust.storage import locked\n"
        "with locked(Path(sys.argv[1])):\n"
        "    print('held', flush=True); time.sleep(0.3)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, in_force], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        accept(in_force, signers.revocation(6, 5), "f", database, NOW + timedelta(days=1))
    assert read_state(in_force).in_force is None


def test_who_waits_for_another_process_is_told_once(
    in_force: Path, monkeypatch: pytest.MonkeyPatch, signers: Signers, tmp_path: Path, run: Run
) -> None:
    monkeypatch.setattr(storage, "MOMENT_S", 0.02)
    monkeypatch.setattr(storage, "LONGEST_WAIT_S", 0.1)
    (tmp_path / "r").write_bytes(signers.revocation(6, 5))
    with locked(in_force):
        code, out, err = run("revoke", tmp_path / "r", *on(in_force))
    assert (code, out) == (1, "")
    assert err.splitlines() == [
        f"ecu-node: {in_force}: another process changes it now; waiting for it, 0.1 s at most",
        f"ecu-node: {in_force}: another process changes it now; try again",
    ]
