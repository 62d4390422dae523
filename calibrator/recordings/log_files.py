"""Files of recordings: alone, in folders, in ``.zip`` archives, gzipped.

A file inside an archive has the path ``fleet.zip/V0001/monday.log``, as if the archive were a folder.
"""

import codecs
import gzip
import io
import shlex
import shutil
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, TextIO, cast

import pandas as pd

from calibrator.errors import LogError
from ecu_node.errors import UserError

__all__ = [
    "MAX_DAMAGED_SHARE",
    "UNREADABLE",
    "exists",
    "file_on_disk",
    "files_in",
    "open_log",
    "read_rows",
    "read_undamaged",
    "readable",
    "reason_of",
    "remedy_for",
    "suffix_of",
    "text_blocks",
    "text_head",
]

UNREADABLE = (OSError, EOFError, zlib.error)
"""What opening and unpacking may raise; gzip.BadGzipFile is an OSError."""
_NO_ARCHIVE = (*UNREADABLE, zipfile.BadZipFile, UnicodeError, RuntimeError, KeyError)
"""What opening and unpacking an archive may raise; RuntimeError where it is encrypted."""
_BINARY = (".mf4", ".parquet", ".feather", ".arrow")
"""Formats whose readers need a file that is not packed."""
MAX_DAMAGED_SHARE = 0.05
"""Of the lines of a text log. Recordings of a real car through a serial adapter had up to 3 % broken lines and decoded
well. [1]"""
_HEAD_BYTES = 1 << 16
_READ_BYTES = 1 << 17
"""Asked for at a time: room for all of it is made for each piece that comes. [byte]"""
BLOCK_BYTES = 1 << 23
"""Text parsed at a time: bounds the memory, large enough for calls not to count. [byte]"""


def suffix_of(path: Path) -> str:
    """Suffix of a file, lower case, that of the packed one for ``.gz``."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def open_log(path: Path) -> BinaryIO:
    """Open a file that is in no archive, gzipped or not."""
    return cast("BinaryIO", gzip.open(path, "rb") if path.name.lower().endswith(".gz") else path.open("rb"))


def read_undamaged(file: BinaryIO, size: int) -> tuple[bytes, Exception | None]:
    """As much of so many bytes as can be read, and what kept the rest; a single large read would lose it all."""
    parts: list[bytes] = []
    read1 = cast("io.BufferedIOBase", file).read1
    try:
        while size > 0 and (part := read1(min(size, _READ_BYTES))):
            parts.append(part)
            size -= len(part)
    except UNREADABLE as error:
        return b"".join(parts), error
    return b"".join(parts), None


def text_blocks(file: BinaryIO) -> Iterator[bytes]:
    """Pieces of a text of :data:`BLOCK_BYTES` that end at a line end; those before a damage come before its error."""
    rest, damage, ended = b"", None, False
    while damage is None and not ended:
        part, damage = read_undamaged(file, BLOCK_BYTES)
        ended = not part and damage is None
        text = rest + part
        cut = len(text) if ended else text.rfind(b"\n") + 1
        rest = text[cut:]
        if cut:
            yield text[:cut]
    if damage is not None:
        raise damage


def text_head(path: Path) -> tuple[str, str]:
    """Beginning of a text file that is in no archive, whole lines, and its encoding; of a damaged one what there is."""
    with open_log(path) as file:
        head, damage = read_undamaged(file, _HEAD_BYTES)
    if damage is not None and not head:
        raise damage
    encoding = "utf-16" if head[:2] in {codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE} else "utf-8-sig"
    try:
        text = codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        encoding = "cp1252"
        text = head.decode(encoding, errors="replace")
    return (text.rpartition("\n")[0] if len(head) == _HEAD_BYTES else text), encoding


def read_rows(file: BinaryIO | TextIO, **options: Any) -> tuple[pd.DataFrame, int]:
    """Rows of a CSV, with options of :func:`pandas.read_csv`, and how many had too many cells and are left out."""
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always")
        rows = pd.read_csv(file, index_col=False, skipinitialspace=True, on_bad_lines="warn", **options)
    return rows, sum(str(complaint.message).count("Skipping line") for complaint in complaints)


def reason_of(error: BaseException) -> str:
    """One line that says what an error of a reader means."""
    if isinstance(error, EOFError):
        return "the compressed file is cut off"
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


def remedy_for(path: Path, frames: int) -> str:
    """What to do with a text log of which only the first frames can be read."""
    if not frames or not path.name.lower().endswith(".gz"):
        return "copy the file again"
    part = f"'gzip -dc {shlex.quote(path.name)} > {shlex.quote(path.stem)}'"
    return f"copy the file again, or keep the readable part, {part}, and remove {path.name}"


def exists(path: Path) -> bool:
    """Whether there is such a file, alone or in an archive."""
    archive = _archive(path)
    return path.is_file() if archive is None else path in files_in(archive)


def files_in(path: Path) -> list[Path]:
    """All files in a folder, at any depth, or in an archive, but hidden ones; none for another file.

    Raises
    ------
    LogError
        If the archive is damaged.
    """
    if path.is_dir():
        return sorted(inner for inner in path.rglob("[!.]*") if inner.is_file())
    if path.suffix.lower() != ".zip" or not path.is_file():
        return []
    try:
        with zipfile.ZipFile(path) as archive:
            names = [PurePosixPath(name) for name in archive.namelist() if not name.endswith("/")]
    except _NO_ARCHIVE as error:
        raise LogError(f"{path}: not a readable archive: {error}; pack or copy it again") from None
    return sorted(
        path / name for name in names if name.name[:1] not in {"", "."} and ".." not in name.parts and name.root == ""
    )


@contextmanager
def readable(path: Path) -> Iterator[Path]:
    """A file that can be read by its path: the file itself, or a copy out of an archive.

    Errors of the user that name the copy come out with the path that the user knows.
    """
    archive = _archive(path)
    if archive is None and not (path.name.lower().endswith(".gz") and suffix_of(path) in _BINARY):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="recording-") as folder:
        copy = Path(folder) / path.name
        try:
            if archive is None:
                copy = copy.with_suffix("")
                with open_log(path) as packed, copy.open("wb") as file:
                    shutil.copyfileobj(packed, file)
            else:
                with zipfile.ZipFile(archive) as members, copy.open("wb") as file:
                    shutil.copyfileobj(members.open(path.relative_to(archive).as_posix()), file)
        except _NO_ARCHIVE as error:
            raise LogError(f"{path}: cannot be unpacked: {str(error).strip(chr(39))}; copy the file again") from None
        try:
            if archive is not None and copy.name.lower().endswith(".gz"):
                with readable(copy) as inner:
                    yield inner
            else:
                yield copy
        except UserError as error:
            raise type(error)(str(error).replace(str(copy), str(path))) from None


def file_on_disk(path: Path) -> Path:
    """The file itself, or the archive that it is in."""
    return _archive(path) or path


def _archive(path: Path) -> Path | None:
    return next((parent for parent in path.parents if parent.suffix.lower() == ".zip" and parent.is_file()), None)
