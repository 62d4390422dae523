"""Audit log: a line for everything that was accepted, refused, activated or taken back; lines are only ever added.

Each line holds the SHA-256 of the one before, so that a line that was changed or taken out shows. What changes the
state of the vehicle is written into the state itself first, in one step with the change, and then added to the log:
after a power cut between the two it is added before anything else is (:func:`tell`). So the log tells of no change that
was not made, and of each that was.
"""

from datetime import UTC, datetime
from pathlib import Path

import msgspec

from ecu_node.trust.canonical import canonical_bytes
from ecu_node.trust.log_lines import lines, lines_from_the_end
from ecu_node.trust.storage import append_line

__all__ = ["REFUSED", "AuditEntry", "Event", "add_entry", "broken_line", "event_now", "is_told", "tell"]

REFUSED = "refused"
"""The one event that changes nothing."""
_FIRST = "0" * 64
_MOST_TEXT = 1000
"""A text of a stranger's file is not to fill the disk."""


class Event(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What happened."""

    time: str
    event: str
    text: str
    sequence: int | None = None
    sha256: str | None = None


class AuditEntry(Event, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One line."""

    before: str


def event_now(event: str, text: str, *, now: datetime, sequence: int | None = None, sha256: str | None = None) -> Event:
    """What happens now.

    Parameters
    ----------
    event, text : str
        What, in a word and in words; what UTF-8 cannot say is escaped.
    now : datetime
        When.
    sequence, sha256 : optional
        Number of the statement concerned, and digest of the file that it came in.

    Returns
    -------
    Event
        To be kept.
    """
    return Event(
        time=now.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        event=event,
        text=text[:_MOST_TEXT].encode(errors="backslashreplace").decode(),
        sequence=sequence,
        sha256=sha256,
    )


def add_entry(path: Path, event: Event) -> None:
    """Add a line.

    Parameters
    ----------
    path : Path
        The log.
    event : Event
        What happened.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    last = next(lines_from_the_end(path), None)
    entry = AuditEntry(**msgspec.structs.asdict(event), before=last.digest if last is not None else _FIRST)
    append_line(path, canonical_bytes(entry))


def tell(path: Path, event: Event | None) -> None:
    """Add the last change of the state, unless it stands there; parameters and errors as for :func:`add_entry`."""
    if event is not None and not is_told(path, event):
        add_entry(path, event)


def is_told(path: Path, event: Event) -> bool:
    """Whether this is the last change of which the log tells."""
    entries = (_entry(line.text) for line in lines_from_the_end(path))
    last = next((entry for entry in entries if entry is not None and entry.event != REFUSED), None)
    return last is not None and last == AuditEntry(**msgspec.structs.asdict(event), before=last.before)


def broken_line(path: Path) -> int | None:
    """Look whether the log is as it was written.

    Each line begins with the digest of the one before, also one that a power cut has cut off: so much of it as is
    there, and zeros where a file system had grown the file and not filled it yet.

    Parameters
    ----------
    path : Path
        The log.

    Returns
    -------
    int or None
        Number of the first line that is not what was written there, from 1; None if all are.

    Raises
    ------
    UserError
        If it cannot be read.
    """
    before = _FIRST
    for number, line in enumerate(lines(path), start=1):
        start = b'{"before":"%b"' % before.encode()
        if not start.startswith(line.text.rstrip(b"\0")[: len(start)]):
            return number
        before = line.digest
    return None


def _entry(line: bytes) -> AuditEntry | None:
    """What a line says; None if it was cut off."""
    try:
        return msgspec.json.decode(line, type=AuditEntry)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
