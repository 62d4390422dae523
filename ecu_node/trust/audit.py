"""Audit log: a line for everything that was accepted, refused, activated or taken back; lines are only ever added.

Each line holds the SHA-256 of the one before, so that a line that was changed or taken out shows. What changes the
state of the vehicle is written into the state itself first, in one step with the change, and then added to the log:
after a power cut between the two it is added before anything else is (:func:`tell`). So the log tells of no change that
was not made, and of each that was. The state holds that line as it is added, with the digest of the one before: so a
log that is missing, or cut further back than a power cut could do it, shows as well.
"""

from datetime import UTC, datetime
from enum import Enum
from pathlib import Path

import msgspec

from ecu_node.trust.canonical import canonical_bytes
from ecu_node.trust.log_lines import lines, lines_from_the_end
from ecu_node.trust.storage import append_line

__all__ = [
    "REFUSED",
    "AuditEntry",
    "End",
    "Event",
    "add_entry",
    "broken_line",
    "end_of_log",
    "event_now",
    "next_entry",
    "tell",
]

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


class End(Enum):
    """How a log ends, as the state knows it."""

    TOLD = "with the last change"
    LEFT = "before the last change, which a power cut has kept from it"
    LOST = "somewhere else: lines are missing, or all of it"


def next_entry(path: Path, event: Event) -> AuditEntry:
    """What would be the next line; raises UserError if the log cannot be read."""
    last = next(lines_from_the_end(path), None)
    return _after(event, last.digest if last is not None else _FIRST)


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
    append_line(path, canonical_bytes(next_entry(path, event)))


def tell(path: Path, made_by: AuditEntry | None) -> None:
    """Add the last change of the state, unless it stands there.

    Parameters
    ----------
    path : Path
        The log.
    made_by : AuditEntry or None
        The change. Where lines before it are lost it is added as it was to stand there: so it shows that they are.

    Raises
    ------
    UserError
        As for :func:`add_entry`.
    """
    if made_by is None:
        return
    match end_of_log(path, made_by):
        case End.LEFT:
            add_entry(path, made_by)
        case End.LOST:
            append_line(path, canonical_bytes(made_by))


def end_of_log(path: Path, made_by: AuditEntry) -> End:
    """How a log ends.

    Parameters
    ----------
    path : Path
        The log.
    made_by : AuditEntry
        The last change of the state. The line that is added may have another one before it: what a power cut left.

    Returns
    -------
    End
        As the state knows it. Refusals after the last change may be missing.

    Raises
    ------
    UserError
        If it cannot be read.
    """
    for line in lines_from_the_end(path):
        entry = _entry(line.text)
        if entry is not None and entry == _after(made_by, entry.before):
            return End.TOLD
        if line.digest == made_by.before:
            return End.LEFT
        if entry is not None and entry.event != REFUSED:
            return End.LOST
    return End.LEFT if made_by.before == _FIRST else End.LOST


def _after(event: Event, before: str) -> AuditEntry:
    return AuditEntry(**{**msgspec.structs.asdict(event), "before": before})


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
