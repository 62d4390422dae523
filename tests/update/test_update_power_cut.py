"""A power cut at any moment, a full disk, a broken disk: the state of a vehicle is the old or the new one.

Programs are killed as they enter each system call with which they change the state: this is every moment there is, as
nothing on the disk changes between the end of one call and the begin of the next. What was written and not yet synced
is then cut short as well, as a disk without power does it.
"""

import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.parameters import VehicleParameters
from ecu_node.update.state import VehicleState, read_state
from ecu_node.update.store import conclude
from tests.ecu_node.vehicles import LAYOUT
from tests.update.repo import Repo
from tests.update.system_calls import calls_of, failing, killed_before, not_synced, traced

FILES = ("lock", "state.json", ".state.json.new", "decisions.log")
CONCLUDE = (
    "import sys; sys.modules['asammdf'] = None  # as the node does it: python-can would bring numpy with it\n"
    "from datetime import UTC, datetime; from pathlib import Path\n"
    "from ecu_node.update.state import read_state; from ecu_node.update.store import conclude\n"
    "state = Path(sys.argv[1])\n"
    "conclude(state, read_state(state).on_trial, passed=True, text='seen', now=datetime.now(UTC))\n"
)


@pytest.fixture
def command(
    repo: Repo, state: Path, other: VehicleParameters, request: pytest.FixtureRequest
) -> Callable[[Path], list[str]]:
    """A command that changes the state of a vehicle: an update, a revocation, the end of a trial."""
    if request.param == "revoke":
        repo.revoke()
    else:
        repo.offer(other)
    if request.param == "conclude":
        repo.updated(state)
        return lambda work: [sys.executable, "-c", CONCLUDE, str(work)]
    options = ["--layout", str(LAYOUT), "--state"]
    return lambda work: [sys.executable, "-m", "ecu_node", "update", str(repo.path), *options, str(work)]


def timeless(folder: Path) -> VehicleState:
    """The state, with the latest time seen replaced by a fixed one."""
    return replace(read_state(folder), latest=datetime(2026, 1, 1, tzinfo=UTC))


def started(state: Path, work: Path) -> Path:
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(state, work)
    return work


def cuts(folder: Path, files: list[Path], place: Path) -> Iterator[Path]:
    """What a disk without power may hold: a part of what was not synced, or, last, all that was written."""
    for file in files:
        whole = file.read_bytes() if file.exists() else b""
        for kept in sorted({0, 1, len(whole) // 2, max(len(whole) - 1, 0)}):
            if file.name == "decisions.log":
                continue  # a log for people, of which nothing is read
            started(folder, place)
            (place / file.name).write_bytes(whole[:kept])
            yield place
    yield folder


LONG = [pytest.param(name, marks=pytest.mark.long) for name in ("update", "revoke")]


@pytest.mark.parametrize("command", ["conclude", *LONG], indirect=True)
def test_power_cut_leaves_old_or_new_state(command: Callable[[Path], list[str]], state: Path, tmp_path: Path) -> None:
    work, log = tmp_path / "work", tmp_path / "log"
    calls = calls_of(command(started(state, work)), work, FILES, log)
    before, after = timeless(state), timeless(work)
    assert before != after
    seen = set()
    for place, call in enumerate(calls):
        if not call.changes:
            continue
        result = traced(command(started(state, work)), work, FILES, log, killed_before(call))
        assert result.returncode == -signal.SIGKILL, f"{call}: {result.stderr}"
        for folder in cuts(work, not_synced(calls[:place]), tmp_path / "cut"):
            found = timeless(folder)
            assert found in (before, after), f"killed before {call}"
            seen.add(found == after)
            again = read_state(folder).on_trial
            if again is not None and after.on_trial is None:
                conclude(folder, again, passed=True, text="seen", now=datetime.now(UTC))
                assert timeless(folder) == after
    assert seen == {False, True}


ERRORS = {"openat": "ENOSPC", "write": "ENOSPC", "fsync": "EIO", "rename": "EIO", "unlink": "EIO", "fchown": "EPERM"}


@pytest.mark.parametrize("command", ["update"], indirect=True)
def test_failed_write_keeps_old_or_new_state(command: Callable[[Path], list[str]], state: Path, tmp_path: Path) -> None:
    work, log = tmp_path / "work", tmp_path / "log"
    calls = calls_of(command(started(state, work)), work, FILES, log)
    before, after = timeless(state), timeless(work)
    commit = next(place for place, call in enumerate(calls) if call.name == "rename" and call.path.name == "state.json")
    for place, call in enumerate(calls):
        if not call.changes:
            continue
        error = failing(call, ERRORS[call.name], from_then_on=call.name == "write")
        result = traced(command(started(state, work)), work, FILES, log, error)
        (line,) = result.stderr.splitlines()
        assert (result.returncode, result.stdout) == (1, ""), f"{call}: {line}"
        assert line.startswith("ecu-node: ")
        assert str(work) in line
        is_done = place > commit
        assert timeless(work) == (after if is_done else before), f"{call}: {line}"
        assert ("may not outlast a power cut" in line or "holds all the same" in line) == is_done
