"""Logs as the doctor looks at them: frames in the order of time, and what became of them as a drive."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database.can import Message

from calibrator.drive import Array, Drive
from calibrator.errors import LogError
from calibrator.recordings.frame_arrays import Frames, frame_key
from calibrator.recordings.frames import read_frames
from calibrator.recordings.log_time import LogTime, repaired_time
from calibrator.recordings.readers import drive_from_frames
from ecu_node.database import VehicleDatabase

__all__ = ["ReadLog", "read_logs"]

MOST_MINUTES = 60.0
"""Of each log: an hour tells what is wrong with a layout, and takes some seconds. [min]"""


@dataclass(frozen=True, kw_only=True)
class ReadLog:
    """One log.

    Attributes
    ----------
    name : str
        Its file.
    frames : Frames
        Data frames in the order of time.
    time : LogTime
        Their times, and what was wrong with these.
    drive : Drive or None
        None if the log has no branch of the layout; `why_no_drive` then tells what it has.
    why_no_drive : str
        Empty if there is a drive.
    cut : bool
        Whether the log goes on after :data:`MOST_MINUTES`, where it was cut.
    """

    name: str
    frames: Frames
    time: LogTime
    drive: Drive | None
    why_no_drive: str
    cut: bool

    def of_message(self, message: Message) -> tuple[Frames, Array]:
        """Frames of a message, and their times since the start of the log. [s]"""
        key = frame_key(message.frame_id, extended=message.is_extended_frame)
        index = np.flatnonzero(self.frames.key == np.uint32(key))
        return self.frames.take(index), self.time.time_s[index]


def read_logs(paths: Sequence[Path], database: VehicleDatabase) -> list[ReadLog]:
    """Read logs of one vehicle.

    Parameters
    ----------
    paths : sequence of Path
        The logs.
    database : VehicleDatabase
        DBC and layout, every signal of which is known.

    Returns
    -------
    list of ReadLog
        One per log; a log without any branch has no drive.

    Raises
    ------
    LogError
        If a log cannot be read.
    """
    return [_read(path, database) for path in paths]


def _read(path: Path, database: VehicleDatabase) -> ReadLog:
    whole = read_frames(path)
    time = repaired_time(whole.time_ns)
    first = int(np.searchsorted(time.time_s, 60.0 * MOST_MINUTES, side="right"))
    frames = whole.take(np.sort(time.order[:first]))  # in the order of the file
    time = repaired_time(frames.time_ns)
    drive, why = None, ""
    try:
        name = path.name.partition(".")[0]
        drive = drive_from_frames(frames, database, vehicle=database.layout.name, name=name, where=str(path)).drive
    except LogError as error:
        why = str(error)
    return ReadLog(
        name=str(path),
        frames=frames.take(time.order),
        time=time,
        drive=drive,
        why_no_drive=why,
        cut=first < len(whole),
    )
