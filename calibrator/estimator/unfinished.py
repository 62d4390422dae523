"""The hidden folder beside a result, ``.RESULT.unfinished/``, from which a run that was killed goes on.

It holds the summaries of drives read so far, a plan (a digest of all that decides what is computed), and two files per
chunk of vehicles that is done. Chunks count only for their plan: with other settings or summaries they are made anew.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from calibrator.errors import FleetError
from calibrator.estimator.results import ChunkResult
from calibrator.files.storage import DISK_FULL
from ecu_node.documents import write_atomically
from ecu_node.layout import file_digest

__all__ = ["Unfinished", "unfinished_run"]


@dataclass(frozen=True, kw_only=True)
class Unfinished:
    """The folder of a run.

    Attributes
    ----------
    folder : Path
        Where it is.
    out : Path
        Where the result will be.
    shown : Path
        The same, as the user named it.
    """

    folder: Path
    out: Path
    shown: Path

    @property
    def summaries(self) -> Path:
        """Store of the summaries of drives that this run reads itself."""
        return self.folder / "summaries"

    def part(self, number: int, what: Literal["rows", "parameters"]) -> Path:
        """File with the rows or the parameters of a chunk."""
        return self.folder / "chunks" / f"{number:05d}.{what}.parquet"

    def put(self, number: int, chunk: ChunkResult) -> None:
        """Keep a chunk; it counts from when its rows are there, which are written last."""
        write_atomically(self.part(number, "parameters"), chunk.parameters)
        write_atomically(self.part(number, "rows"), chunk.rows)

    def done(self) -> list[int]:
        """Numbers of the chunks that are there."""
        return sorted(int(path.name[:5]) for path in self.folder.glob("chunks/[0-9]*.rows.parquet"))

    def begin(self, plan: str | None, created: str) -> str:
        """Keep the chunks that are there if they were computed by the same plan, else remove them.

        ``plan`` is a digest of what the run computes and from what, None to begin anew; ``created`` the time of this
        run. Returned is the time of the first run of this plan.
        """
        path = self.folder / "plan"
        before, _, noted = path.read_text().partition("\n") if path.exists() else ("", "", "")
        if plan is not None and before == plan:
            return noted
        path.unlink(missing_ok=True)  # first, so that no other plan is ever taken for that of the chunks
        _empty(self.folder / "chunks")
        write_atomically(path, f"{plan or ''}\n{created}".encode())
        return created

    def summaries_since(self, earlier: Path | None) -> None:
        """Begin the store of summaries with those of an earlier result, unless this was done before, or with none."""
        mark = "" if earlier is None else f"{earlier.absolute()} {file_digest(earlier / 'run.json')}"
        there = self._since.read_text() if self._since.exists() else ""
        if there == mark and (earlier is None or self.summaries.exists()):
            return
        self._since.unlink(missing_ok=True)
        shutil.rmtree(self.summaries, ignore_errors=True)
        if earlier is None:
            return
        copy = self.folder / "summaries.copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(earlier / "summaries", copy, ignore=shutil.ignore_patterns(".*"))
        copy.rename(self.summaries)
        write_atomically(self._since, mark.encode())

    @property
    def _since(self) -> Path:
        """Which earlier result's summaries were copied; written after them."""
        return self.folder / "since"

    def worth_keeping(self) -> bool:
        """Whether anything was computed: a chunk, or summaries of drives besides those of an earlier result."""
        copied = self._since.stat().st_mtime_ns if self._since.exists() else 0
        buckets = self.summaries.glob("buckets/[0-9]*.parquet")
        return bool(self.done()) or any(path.stat().st_mtime_ns >= copied for path in buckets)

    def result(self) -> Path:
        """Empty folder for the result; what a killed run has put there is gone."""
        return _empty(self.folder / "result")

    def finish(self) -> None:
        """Put the result where it belongs, and remove the rest."""
        made = self.folder / "result"
        try:
            if self.out.exists():
                self.out.rmdir()
            made.rename(self.out)
        except OSError as error:
            why = f"cannot be replaced: {error.strerror}; what was made stands in {made}"
            raise FleetError(f"{self.out}: {why}") from None
        shutil.rmtree(self.folder, ignore_errors=True)


def _empty(folder: Path) -> Path:
    """The folder, made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


@contextmanager
def unfinished_run(out: Path) -> Iterator[Unfinished]:
    """Open the folder of a run; it is made if there is none, and removed if nothing worth keeping is in it.

    Parameters
    ----------
    out : Path
        New or empty folder of the result.

    Yields
    ------
    Unfinished
        Locked against a second run to the same place.

    Raises
    ------
    FleetError
        If another run writes there, the folder cannot be made, or the disk is full.
    """
    shown, out = out, out.absolute()
    folder = out.with_name(f".{out.name}.unfinished")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise FleetError(f"{out}: cannot be made: {error.strerror}; choose another folder") from None
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            why = "another run is writing this result; wait for it or choose another --out"
            raise FleetError(f"{out}: {why}") from None
        unfinished = Unfinished(folder=folder, out=out, shown=shown)
        try:
            yield unfinished
        except OSError as error:
            raise _full_disk(error, folder) or error from None
        finally:
            if not unfinished.worth_keeping():
                shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def _full_disk(error: OSError, folder: Path) -> FleetError | None:
    """What to say of a disk without room; libraries leave out the name of the file. None: it is another error."""
    where, reason = error.filename or folder, os.strerror(error.errno or 0)
    if isinstance(error, shutil.Error):  # of a folder that was copied: the first of its files that was not
        (_, where, reason), *_ = error.args[0]
    elif error.errno not in DISK_FULL:
        return None
    return FleetError(
        f"{where}: cannot write it: {reason}; make room, and run the same command again to go on, or choose another "
        f"--out"
    )
