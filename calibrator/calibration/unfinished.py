"""What a run that is not finished has done so far: a hidden folder beside the result, from which the next run goes on.

``.RESULT.unfinished/`` holds the summaries of drives read so far, and what was computed from them: the plan, and one
file per step that is done. What is computed counts only for its plan: other settings, or other summaries, and it is
done anew.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from calibrator.errors import FleetError
from calibrator.files.storage import DISK_FULL
from calibrator.results.chunk import ChunkResult
from ecu_node.layout import file_digest
from ecu_node.user_files import write_atomically

__all__ = ["Chunks", "Unfinished", "unfinished_run"]

SUMMARIES, CHUNKS, RESULT, PLAN = "summaries", "chunks", "result", "plan"


@dataclass(frozen=True, kw_only=True)
class Chunks:
    """Chunks of a run, each one file for its rows and one for its parameters.

    Attributes
    ----------
    folder : Path
        Where they are.
    """

    folder: Path

    def done(self, number: int) -> bool:
        """Whether a chunk is there."""
        return self.rows(number).exists() and self.parameters(number).exists()

    def put(self, number: int, result: ChunkResult) -> None:
        """Keep a chunk; it counts from when its rows are there, which are written last."""
        write_atomically(self.parameters(number), result.parameters)
        write_atomically(self.rows(number), result.rows)

    def numbers(self) -> list[int]:
        """Chunks that are there."""
        return sorted(int(path.name.partition(".")[0]) for path in self.folder.glob("[0-9]*.rows.parquet"))

    def rows(self, number: int) -> Path:
        """File with the rows of a chunk."""
        return self.folder / f"{number:05d}.rows.parquet"

    def parameters(self, number: int) -> Path:
        """File with the parameters of a chunk."""
        return self.folder / f"{number:05d}.parameters.parquet"


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
        return self.folder / SUMMARIES

    @property
    def chunks(self) -> Chunks:
        """What was computed."""
        return Chunks(folder=self.folder / CHUNKS)

    def summaries_since(self, earlier: Path | None) -> None:
        """Begin the store of summaries with those of an earlier result, unless this was done before, or with none."""
        marker, mark = self._since, "" if earlier is None else _mark(earlier)
        there = marker.read_text() if marker.exists() else ""
        if there == mark and (earlier is None or self.summaries.exists()):
            return
        marker.unlink(missing_ok=True)
        shutil.rmtree(self.summaries, ignore_errors=True)
        if earlier is None:
            return
        copy = self.folder / "summaries.copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(earlier / SUMMARIES, copy, ignore=shutil.ignore_patterns(".*"))
        copy.rename(self.summaries)
        write_atomically(marker, mark.encode())

    def worth_keeping(self) -> bool:
        """Whether anything was computed: a chunk, or summaries of drives besides those of an earlier result."""
        if self.chunks.numbers():
            return True
        copied = self._since.stat().st_mtime_ns if self._since.exists() else 0
        buckets = self.summaries.glob("buckets/[0-9]*.parquet")
        return any(path.stat().st_mtime_ns >= copied for path in buckets)

    @property
    def _since(self) -> Path:
        """Which earlier result's summaries were copied; written after them."""
        return self.folder / "since"

    def begin(self, plan: str | None, note: str) -> str:
        """Keep the chunks that are there if they were computed by the same plan, else remove them.

        Parameters
        ----------
        plan : str or None
            What the run computes, and from what; one line. None: begin anew.
        note : str
            What the run is told by, such as its time; one line.

        Returns
        -------
        str
            The note of the first run of this plan.
        """
        path = self.folder / PLAN
        before, _, noted = path.read_text().partition("\n") if path.exists() else ("", "", "")
        if plan is not None and before == plan:
            return noted
        path.unlink(missing_ok=True)  # first, so that no other plan is ever taken for that of the chunks
        shutil.rmtree(self.folder / CHUNKS, ignore_errors=True)
        (self.folder / CHUNKS).mkdir()
        write_atomically(path, f"{plan or ''}\n{note}".encode())
        return note

    def result(self) -> Path:
        """Empty folder for the result; what a killed run has put there is gone."""
        folder = self.folder / RESULT
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    def finish(self) -> None:
        """Put the result where it belongs, and remove the rest."""
        try:
            if self.out.exists():
                self.out.rmdir()
            (self.folder / RESULT).rename(self.out)
        except OSError as error:
            made = self.folder / RESULT
            raise FleetError(
                f"{self.out}: cannot be replaced: {error.strerror}; what was made stands in {made}"
            ) from None
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def unfinished_run(out: Path) -> Iterator[Unfinished]:
    """Open the folder of a run; it is made if there is none.

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
        If another run writes there, or the folder cannot be made.
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
            raise FleetError(
                f"{out}: another run is writing this result; wait for it or choose another --out"
            ) from None
        unfinished = Unfinished(folder=folder, out=out, shown=shown)
        try:
            with _disk_full_told(unfinished):
                yield unfinished
        finally:
            if not unfinished.worth_keeping():
                shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


@contextmanager
def _disk_full_told(unfinished: Unfinished) -> Iterator[None]:
    """Say where there is no room, and what to do; libraries leave out the name of the file."""
    try:
        yield
    except OSError as error:
        where, reason = error.filename or unfinished.folder, os.strerror(error.errno or 0)
        if isinstance(error, shutil.Error):  # of a folder that was copied: the first of its files that was not
            (_, where, reason), *_ = error.args[0]
        elif error.errno not in DISK_FULL:
            raise
        raise FleetError(
            f"{where}: cannot write it: {reason}; make room, and run the same command again to go on, or choose "
            f"another --out"
        ) from None


def _mark(result: Path) -> str:
    return f"{result.absolute()} {file_digest(result / 'run.json')}"
