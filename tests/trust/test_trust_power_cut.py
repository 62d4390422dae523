"""A power cut at any moment, a full disk, a broken disk: the state of a vehicle is that of before or that of after.

Programs are killed as they enter each system call with which they change the state: this is every moment there is, as
nothing on the disk changes between the end of one call and the begin of the next. What was written and not yet synced
is then cut short as well, as a disk without power does it.
"""

import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from ecu_node.core.status import TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.audit import REFUSED, AuditEntry, broken_line
from ecu_node.trust.envelope import read_envelope
from ecu_node.trust.envelope import signers as signers_of
from ecu_node.trust.provision import provision
from ecu_node.trust.state import TrustState, audit_path, read_slot, read_state, signed_parameters
from tests.ecu_node.vehicles import LAYOUT
from tests.trust.signing import VEHICLE, Signers
from tests.trust.system_calls import Call, calls_of, failing, killed_before, not_synced, traced

FILES = (
    *("lock", "state.json", ".state.json.new", "audit.log"),
    *("slot-a.json", "slot-b.json", "slot-a.json.next", "slot-b.json.next"),
)
CONCLUDE = (
    "import sys; sys.modules['asammdf'] = None  # as the node does it: python-can would bring numpy with it\n"
    "from datetime import UTC, datetime; from pathlib import Path\n"
    "from ecu_node.trust.activation import conclude\n"
    "conclude(Path(sys.argv[1]), 7, passed=sys.argv[2] == 'passed', text='seen', now=datetime.now(UTC))\n"
)
Told = list[tuple[str, int | None]]


@dataclass(frozen=True, kw_only=True)
class Change:
    """A command that changes the state of a vehicle, and how the state is before it."""

    state: Path
    """With numbers 5 and 6 in their slots, 6 in force; on trial is 7, or nothing yet."""
    command: Callable[[Path], list[str]]
    again: Callable[[Path], object]
    event: tuple[str, int]
    is_replayed: bool
    """Whether the same command is refused once it is done; else it changes nothing."""

    def start(self, work: Path) -> list[str]:
        """Put the state of before in a folder; the command on it."""
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(self.state, work)
        return self.command(work)


@pytest.fixture(scope="module")
def home(
    tmp_path_factory: pytest.TempPathFactory,
    signers: Signers,
    parameters: VehicleParameters,
    database: VehicleDatabase,
) -> Path:
    """Two vehicles, before an activation and within a trial, and signed files."""
    now = datetime.now(UTC)
    home = tmp_path_factory.mktemp("power cut")
    provision(home / "before", VEHICLE, signers.keys(), now)

    def signed(number: int) -> bytes:
        return signers.parameters(parameters, number, not_before=now - timedelta(hours=1))

    for number in (5, 6):
        accept(home / "before", signed(number), "f", database, now)
        conclude(home / "before", number, passed=True, text="seen", now=now)
    (home / "7.json").write_bytes(signed(7))
    (home / "8.json").write_bytes(signers.revocation(8, 6))
    shutil.copytree(home / "before", home / "trial")
    accept(home / "trial", signed(7), "f", database, now)
    return home


def change_of(home: Path, what: str, database: VehicleDatabase) -> Change:
    def taking(name: str, number: int, event: str) -> Change:
        file = home / f"{number}.json"
        options = ["--layout", str(LAYOUT), "--state"]
        return Change(
            state=home / "before",
            command=lambda state: [sys.executable, "-m", "ecu_node", name, str(file), *options, str(state)],
            again=lambda state: accept(state, file.read_bytes(), "f", database, datetime.now(UTC)),
            event=(event, number),
            is_replayed=True,
        )

    def concluding(how: str, event: str) -> Change:
        return Change(
            state=home / "trial",
            command=lambda state: [sys.executable, "-c", CONCLUDE, str(state), how],
            again=lambda state: conclude(state, 7, passed=how == "passed", text="seen", now=datetime.now(UTC)),
            event=(event, 7),
            is_replayed=False,
        )

    return {
        "activate": lambda: taking("activate", 7, "on trial"),
        "revoke": lambda: taking("revoke", 8, "revoked"),
        "passed": lambda: concluding("passed", "in force"),
        "failed": lambda: concluding("failed", "failed"),
    }[what]()


def state_of(folder: Path) -> TrustState:
    """The state, but for what made it, whose time is not the same twice."""
    return replace(read_state(folder), made_by=None)


def told(folder: Path) -> Told:
    """What the audit log tells of changes; a line that was cut off tells nothing."""
    found = []
    for line in audit_path(folder).read_bytes().splitlines():
        try:
            entry = msgspec.json.decode(line, type=AuditEntry)
        except msgspec.DecodeError:
            continue
        found.append((entry.event, entry.sequence))
    return found


def require_whole(folder: Path, signers: Signers) -> None:
    """Every slot that the state speaks of holds what was signed, and only what was tried before is in force."""
    state = read_state(folder)
    assert broken_line(audit_path(folder)) is None
    for name, slot in state.slots.items():
        assert signed_parameters(folder, state, name).sequence == slot.sequence
        envelope = read_envelope(read_slot(folder, state, name), "f")
        assert len(signers_of(envelope, signers.keys(), "f")) == 2
    if state.in_force is not None:
        number = state.slots[state.in_force].sequence
        assert number in (5, 6) or ("in force", number) in [*told(folder), _made(state)]


def _made(state: TrustState) -> tuple[str, int | None] | None:
    return (state.made_by.event, state.made_by.sequence) if state.made_by is not None else None


def cuts(folder: Path, files: list[Path], place: Path) -> Iterator[Path]:
    """What a disk without power may hold: a part of what was not synced, or, last, all that was written."""
    for file in files:
        whole = file.read_bytes() if file.exists() else b""
        synced = 0 if file.name != "audit.log" else whole.rfind(b"\n", 0, -1) + 1
        for kept in sorted({synced, synced + 1, (synced + len(whole)) // 2, len(whole) - 1}):
            for rest in (b"", bytes(len(whole) - kept)):
                shutil.rmtree(place, ignore_errors=True)
                shutil.copytree(folder, place)
                (place / file.name).write_bytes(whole[:kept] + rest)
                yield place
    yield folder


@pytest.mark.parametrize("what", ["activate", "revoke", "passed", "failed"])
def test_a_power_cut_at_any_moment_leaves_the_state_of_before_or_of_after(
    what: str, home: Path, signers: Signers, database: VehicleDatabase, tmp_path: Path
) -> None:
    change, work, log = change_of(home, what, database), tmp_path / "state", tmp_path / "log"
    calls = calls_of(change.start(work), work, FILES, log)
    after = state_of(work)
    assert told(work) == [*told(change.state), change.event]
    seen = set()
    for place, call in enumerate(calls):
        if not call.changes:
            continue
        result = traced(change.start(work), work, FILES, log, killed_before(call))
        assert result.returncode == -signal.SIGKILL, f"{call}: {result.stderr}"
        for folder in cuts(work, not_synced(calls[:place]), tmp_path / "cut"):
            try:
                seen.add(state_of(folder) == after)
                require_before_or_after(folder, change, after, signers)
                require_it_can_go_on(folder, change, after, signers)
            except (AssertionError, UserError) as error:
                raise AssertionError(f"killed before {call}, in {folder}: {error}") from error
    assert seen == {False, True}


def require_before_or_after(folder: Path, change: Change, after: TrustState, signers: Signers) -> None:
    found, before = state_of(folder), state_of(change.state)
    assert found in (before, after)
    require_whole(folder, signers)
    changed = [*told(change.state), change.event]
    assert told(folder) == changed[:-1] or (found == after and told(folder) == changed)


def require_it_can_go_on(folder: Path, change: Change, after: TrustState, signers: Signers) -> None:
    """The same command ends where it would have ended, and all is told."""
    if change.is_replayed and state_of(folder) == after:
        with pytest.raises(TrustError, match="was accepted before"):
            change.again(folder)
    else:
        change.again(folder)
    assert state_of(folder) == after
    require_whole(folder, signers)
    assert [item for item in told(folder) if item[0] != REFUSED] == [*told(change.state), change.event]
    assert not list(folder.glob("*.next"))


ERRORS = {
    "openat": "ENOSPC",
    "write": "ENOSPC",
    "fsync": "EIO",
    "rename": "EIO",
    "unlink": "EIO",
    "fchown": "EPERM",
}


def test_a_disk_that_is_full_or_broken_is_one_line_and_the_state_is_that_of_before_or_the_line_says_so(
    home: Path, signers: Signers, database: VehicleDatabase, tmp_path: Path
) -> None:
    change, work, log = change_of(home, "activate", database), tmp_path / "state", tmp_path / "log"
    calls = calls_of(change.start(work), work, FILES, log)
    before, after = state_of(change.state), state_of(work)
    commit = next(place for place, call in enumerate(calls) if call.name == "rename" and call.path.name == "state.json")
    for place, call in enumerate(calls):
        if not call.changes:
            continue
        error = failing(call, ERRORS[call.name], from_then_on=call.name == "write")
        result = traced(change.start(work), work, FILES, log, error)
        (line,) = result.stderr.splitlines()
        assert (result.returncode, result.stdout) == (1, ""), f"{call}: {line}"
        assert line.startswith("ecu-node: "), line
        assert str(work) in line
        is_done = place > commit
        assert state_of(work) == (after if is_done else before), f"{call}: {line}"
        assert ("may not outlast a power cut" in line or "holds all the same" in line) == is_done
        require_before_or_after(work, change, after, signers)
        require_it_can_go_on(work, change, after, signers)


def test_the_kill_comes_before_the_call(home: Path, database: VehicleDatabase, tmp_path: Path) -> None:
    change, work, log = change_of(home, "activate", database), tmp_path / "state", tmp_path / "log"
    rename = Call(name="rename", number=1, path=work, changes=True)
    traced(change.start(work), work, FILES, log, killed_before(rename))
    assert state_of(work) == state_of(change.state)
    assert (work / ".state.json.new").exists()
