"""State of a vehicle on its disk: which parameters it holds, and which metadata of the repository it trusts.

All of it is one file, ``state.json``, which is replaced whole: after a power cut at any moment the state is the old or
the new one. Its first line is the SHA-256 of the rest, so that a bit that the disk has changed is noticed.
``decisions.log`` has one line of JSON for each decision, to be read by people.
"""

import errno
import fcntl
import hashlib
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ecu_node.core.status import Reason, TrustError
from ecu_node.documents import UnsuitableFileError, read_user_file
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters, decode_parameters

__all__ = [
    "ParameterSet",
    "VehicleState",
    "add_decision",
    "locked",
    "read_state",
    "require_not_expired",
    "state_path",
    "time_text",
    "write_state",
]

_LARGEST_STATE_BYTES = 8_000_000
"""Largest state that is read; metadata of a repository of 10^6 vehicles and three parameter files take about 100 kB."""
_REPLACE = "remove this file alone, then 'ecu-node provision' and 'ecu-node update'"
_FOLDER = "name a folder made by 'ecu-node provision'"
_CAREFUL = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""Flags for opening files safely when root writes into the node's folder: no link is followed, no pipe blocks."""
_LONGEST_WAIT_S = 30.0
"""Longest wait for another process that holds the lock; one that was stopped would hold it for ever. [s]"""


class ParameterSet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One parameter file, as the repository offered it."""

    content: str
    expires: datetime

    @property
    def sha256(self) -> str:
        """SHA-256 of the parameter file; revocations name the file by it."""
        return hashlib.sha256(self.content.encode()).hexdigest()

    @property
    def parameters(self) -> VehicleParameters:
        """What the file says; it was checked before it came into the state."""
        return decode_parameters(self.content.encode(), "state.json")

    def __str__(self) -> str:
        """Return a name for messages: number of the set and beginning of its digest."""
        return f"parameter set {self.parameters.number} ({self.sha256[:8]})"


class VehicleState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a vehicle holds and trusts."""

    schema_version: Literal[2] = 2
    vehicle: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    latest: Annotated[datetime, msgspec.Meta(description="latest time seen at a change; no earlier one is believed")]
    root: Annotated[str, msgspec.Meta(description="trusted metadata, as TUF's client keeps it")]
    timestamp: str | None = None
    snapshot: str | None = None
    in_force: ParameterSet | None = None
    on_trial: ParameterSet | None = None
    before: Annotated[ParameterSet | None, msgspec.Meta(description="in force before, for a fall-back")] = None
    failed: Annotated[ParameterSet | None, msgspec.Meta(description="failed its trial, and is not tried again")] = None
    ended: Annotated[
        Literal["revoked", "expired"] | None, msgspec.Meta(description="why the last set is not in force any more")
    ] = None


def state_path(folder: Path) -> Path:
    """Return the path of the file that holds the state."""
    return folder / "state.json"


def time_text(moment: datetime) -> str:
    """Return a time as ISO 8601, UTC, to the second."""
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def require_not_expired(found: ParameterSet, state: VehicleState, now: datetime) -> None:
    """Raise TrustError (NOT_VALID_NOW) if a set has expired; a clock behind the state's latest time is not believed."""
    if max(now, state.latest) >= found.expires:
        believed = f"the latest time seen here is {time_text(state.latest)}, though the clock says {time_text(now)}"
        what = f"now it is {time_text(now)}" if now >= state.latest else believed
        raise TrustError(
            Reason.NOT_VALID_NOW, f"{found} expired at {time_text(found.expires)}, and {what}; publish it anew"
        )


def read_state(folder: Path) -> VehicleState:
    """Read the state of a vehicle.

    Parameters
    ----------
    folder : Path
        State folder, made by 'ecu-node provision'.

    Returns
    -------
    VehicleState
        What the vehicle holds and trusts.

    Raises
    ------
    TrustError
        If there is no state, or it cannot be read, is damaged, or of another version.
    """
    path = state_path(folder)
    try:
        content = read_user_file(path, largest_bytes=_LARGEST_STATE_BYTES)
    except FileNotFoundError:
        raise TrustError(
            Reason.NO_PARAMETERS, f"{folder}: no state of a vehicle there; make one with 'ecu-node provision'"
        ) from None
    except UnsuitableFileError as error:
        raise TrustError(Reason.MALFORMED_PARAMETERS, f"{path}: {error}; {_REPLACE}") from None
    except OSError as error:
        advice = f"; {_FOLDER}" if error.errno == errno.ENOTDIR else ""
        raise TrustError(Reason.NO_PARAMETERS, f"{path}: cannot read the state: {error.strerror}{advice}") from None
    digest, _, document = content.partition(b"\n")
    try:
        if digest != hashlib.sha256(document).hexdigest().encode():
            raise ValueError("its digest is another one")
        return msgspec.json.decode(document, type=VehicleState)
    except ValueError as error:  # also those of msgspec
        raise TrustError(
            Reason.MALFORMED_PARAMETERS, f"{path}: damaged, or of another version: {error}; {_REPLACE}"
        ) from None


def write_state(folder: Path, state: VehicleState) -> None:
    """Replace the state in one step; the folder must be :func:`locked`.

    Raises
    ------
    UserError
        If it cannot be written; the state is as before, unless the message says that the new one may not last.
    """
    document = msgspec.json.encode(state)
    content = hashlib.sha256(document).hexdigest().encode() + b"\n" + document
    path, new = state_path(folder), folder / ".state.json.new"
    try:
        new.unlink(missing_ok=True)
        _write(new, os.O_CREAT | os.O_EXCL, content)
        new.replace(path)
    except OSError as error:
        with suppress(OSError):
            new.unlink(missing_ok=True)
        raise UserError(f"{path}: cannot be written: {error.strerror}; the state is as before") from None
    try:
        _sync_folder(folder)
    except OSError as error:
        raise UserError(
            f"{path}: is written, but may not outlast a power cut: {error.strerror}; look at it with 'ecu-node inspect'"
        ) from None


def add_decision(folder: Path, event: str, text: str, now: datetime, *, reason: Reason | None = None) -> None:
    """Add a line to the log of decisions; raises UserError if it cannot be written."""
    line = {"time": time_text(now), "event": event, "text": text[:1000].encode(errors="backslashreplace").decode()}
    line |= {"reason": reason.name.title().replace("_", "")} if reason is not None else {}
    path = folder / "decisions.log"
    try:
        _write(path, os.O_CREAT | os.O_APPEND, msgspec.json.encode(line) + b"\n")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; '{event}' holds all the same") from None


@contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Within the block, keep other processes from changing a state folder.

    Parameters
    ----------
    folder : Path
        It must exist.
    wait : bool
        Whether to wait for another process, 30 s at most, instead of raising an error at once.

    Raises
    ------
    UserError
        If the folder cannot be used, or another process holds the lock.
    """
    try:
        handle = _open(folder / "lock", os.O_RDWR | os.O_CREAT)
    except OSError as error:
        is_missing = error.errno in (errno.ENOENT, errno.ENOTDIR)
        advice = f"; {_FOLDER}" if is_missing else ""
        raise UserError(f"{folder}: cannot be used as state: {error.strerror}{advice}") from None
    try:
        until_s = time.monotonic() + (_LONGEST_WAIT_S if wait else 0.0)
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until_s:
                    raise UserError(f"{folder}: another process changes it now; try again") from None
                time.sleep(0.01)
        yield
    finally:
        os.close(handle)


def _open(path: Path, flags: int) -> int:
    """Open a file of the state folder; if root does so, give it to the folder's owner, as whom the node runs."""
    handle = os.open(path, flags | _CAREFUL, 0o644)
    try:
        found, owner = os.fstat(handle), path.parent.stat()
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "it is no file; remove it")
        if os.geteuid() == 0 and (found.st_uid, found.st_gid) != (owner.st_uid, owner.st_gid):
            if found.st_nlink != 1:
                raise OSError(errno.EPERM, "it is another name of somebody else's file; remove it")
            os.fchown(handle, owner.st_uid, owner.st_gid)
    except BaseException:
        os.close(handle)
        raise
    return handle


def _write(path: Path, flags: int, content: bytes) -> None:
    with os.fdopen(_open(path, os.O_WRONLY | flags), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
