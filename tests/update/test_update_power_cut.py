"""A power cut at any moment, a full disk, a broken disk: the state of a vehicle is that of before or that of after."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.update.client import update
from ecu_node.update.state import VehicleState, read_state
from ecu_node.update.store import conclude
from tests.disk import full_disk
from tests.update.repo import Repo, one_line, pass_trial

ERRORS = {"open": errno.ENOSPC, "fsync": errno.EIO, "replace": errno.EIO, "unlink": errno.EIO}
"""Calls with which the state of a vehicle is changed, and how each fails on a full or a broken disk."""


class PowerCut(BaseException):
    """Nothing happens on the disk after it, whatever a program does to clean up."""


class Disk:
    """The disk on which a state folder lies; one of the calls that change the folder is its last, or fails."""

    def __init__(self, folder: Path, place: int | None = None, *, fails: bool = False) -> None:
        self.folder, self.place, self.fails = folder, place, fails
        self.calls: list[tuple[str, Path]] = []
        self.unsynced: set[Path] = set()
        """Files of which a power cut may leave any beginning: written, and not synced since."""

    @contextmanager
    def in_use(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            for name in ERRORS:
                patch.setattr(os, name, partial(self._call, name, getattr(os, name)))
            yield

    def _call(self, name: str, call: Callable[..., Any], target: Any, *more: Any, **options: Any) -> Any:
        path = Path(f"/proc/self/fd/{target}").readlink() if isinstance(target, int) else Path(target)
        if self.folder not in (path, path.parent) or (name == "open" and not more[0] & os.O_CREAT):
            return call(target, *more, **options)
        number = len(self.calls)
        self.calls.append((name, path))
        if number == self.place and self.fails:
            raise OSError(ERRORS[name], os.strerror(ERRORS[name]))
        if self.place is not None and number >= self.place and not self.fails:
            raise PowerCut
        found = call(target, *more, **options)
        was_unsynced = path in self.unsynced
        self.unsynced.discard(path)
        if name == "open":
            self.unsynced.add(path)
        elif name == "replace" and was_unsynced:
            self.unsynced.add(Path(more[0]))
        return found


@pytest.fixture
def change(
    request: pytest.FixtureRequest, repo: Repo, state: Path, database: VehicleDatabase, other: VehicleParameters
) -> Callable[[Path], object]:
    """What changes the state of a vehicle: an update, a revocation, the end of a trial."""
    if request.param == "revoke":
        repo.revoke()
    else:
        repo.offer(other)
    if request.param == "conclude":
        repo.updated(state)
        return pass_trial
    return lambda work: update(work, str(repo.path), database, datetime.now(UTC))


def timeless(folder: Path) -> VehicleState:
    """The state, but for the time of the last change."""
    return replace(read_state(folder), latest=datetime(2026, 1, 1, tzinfo=UTC))


def copied(folder: Path, place: Path) -> Path:
    shutil.rmtree(place, ignore_errors=True)
    return Path(shutil.copytree(folder, place))


def left_by_cut(disk: Disk, place: Path) -> Iterator[Path]:
    """What a disk without power may hold: a part of what was not synced, or all that was written."""
    for file in disk.unsynced:
        whole = file.read_bytes()
        for kept in {0, 1, len(whole) // 2}:
            cut = copied(disk.folder, place) / file.name
            cut.write_bytes(whole[:kept])
            yield place
    yield disk.folder


@pytest.mark.parametrize("change", ["update", "revoke", "conclude"], indirect=True)
def test_power_cut_leaves_the_old_or_new_state(change: Callable[[Path], object], state: Path, tmp_path: Path) -> None:
    whole = Disk(copied(state, tmp_path / "whole"))
    inode = (whole.folder / "state.json").stat().st_ino
    with whole.in_use():
        change(whole.folder)
    assert (whole.folder / "state.json").stat().st_ino != inode, "it is replaced whole, never written in place"
    before, after = timeless(state), timeless(whole.folder)
    seen = []
    for place, call in enumerate(whole.calls):
        disk = Disk(copied(state, tmp_path / "work"), place)
        with disk.in_use(), pytest.raises(PowerCut):
            change(disk.folder)
        for folder in left_by_cut(disk, tmp_path / "cut"):
            seen.append(timeless(folder))
            assert seen[-1] in (before, after), f"power cut before {call}"
            again = read_state(folder).on_trial
            if again is not None and after.on_trial is None:
                conclude(folder, again, passed=True, text="seen", now=datetime.now(UTC))
                assert timeless(folder) == after
    assert before in seen
    assert after in seen


def test_failed_disk_write_keeps_the_state_or_is_reported(
    repo: Repo, state: Path, other: VehicleParameters, tmp_path: Path
) -> None:
    repo.offer(other)
    whole = Disk(copied(state, tmp_path / "whole"))
    with whole.in_use():
        repo.updated(whole.folder)
    before, after = timeless(state), timeless(whole.folder)
    names = [name for name, _ in whole.calls]
    for place in range(len(names)):
        disk = Disk(copied(state, tmp_path / "work"), place, fails=True)
        with disk.in_use():
            done = repo.update(disk.folder)
        is_done = place > names.index("replace")
        one_line(done, disk.folder, *(["may not outlast a power cut"] if place == names.index("replace") + 1 else []))
        assert timeless(disk.folder) == (after if is_done else before), done
        assert ("may not outlast a power cut" in done[2] or "holds all the same" in done[2]) == is_done
    with full_disk((state / "state.json").stat().st_size - 1):
        one_line(repo.update(state), state, "cannot be written: File too large")
    assert timeless(state) == before
