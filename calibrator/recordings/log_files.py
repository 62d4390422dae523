"""Find and open files of recordings, alone, in folders, in ``.zip`` archives or gzipped, and tell their kind.

A file inside an archive has the path ``fleet.zip/V0001/monday.log``, as if the archive were a folder.
"""

import codecs
import io
import mmap
import re
import shutil
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, BinaryIO, Literal, TextIO, cast

import pandas as pd
from isal import igzip, isal_zlib

from calibrator.errors import LogError, naming

__all__ = [
    "PRINTED_CANDUMP",
    "TABLE_SUFFIXES",
    "UNREADABLE",
    "exists",
    "files_in",
    "is_bus_log",
    "is_candump",
    "kind_of_text",
    "open_log",
    "read_rows",
    "read_undamaged",
    "readable",
    "reason_of",
    "suffix_of",
    "text_blocks",
    "text_head",
]

UNREADABLE = (OSError, EOFError, zlib.error, isal_zlib.error)
"""Exceptions of opening and unpacking a file; gzip.BadGzipFile is an OSError."""
_NO_ARCHIVE = (*UNREADABLE, zipfile.BadZipFile, UnicodeError, RuntimeError, KeyError)
"""Exceptions of opening and unpacking an archive; RuntimeError if it is encrypted."""
_BINARY = (".mf4", ".parquet", ".feather", ".arrow")
"""Suffixes of formats whose readers cannot read gzip and need an unpacked file."""
PRINTED_CANDUMP = re.compile(
    rb"^[ \t]*(?:\((?P<time>[-\d:. ]+)\)[ \t]+)?(?P<channel>[\w.-]+)[ \t]+(?:[RT]X [-B] [-E][ \t]+)?"
    rb"(?P<id>[\dA-F]{8}|[\dA-F]{3})[ \t]+\[(?P<length>\d+)\](?:[ \t]+(?P<remote>remote request)|[ \t]+(?P<data>"
    rb"(?:[\dA-F]{2} ?)*))[^\r\n]*",
    re.MULTILINE | re.IGNORECASE,
)
"""A line as candump prints it without ``-L``, such as ``can0  2E5   [4]  00 00 07 32``."""
_NUMBER = re.compile(r"(?<![\w.:-])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.:-])")
"""A number in a line of a table that is not part of a date, a time or a word."""
_LOGGED = re.compile(rb"\(\d+\.\d+\) \S+ [\dA-Fa-f]{3,8}#")
TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".parquet", ".feather", ".arrow", ".mf4")
FRAME_COLUMNS = ("arbitration_id", "id", "canid", "can id")
"""Headers of a column of identifiers, lower case; beside a column of data or length, it marks a log of CAN frames."""
_FRAME_CHANNEL = bytes(8) + b"CAN_DataFrame\0"
"""Bytes of an MDF text block with the name of a channel of frames: its number of links (0), then the text."""
_HEAD_BYTES = 1 << 16
_READ_BYTES = 1 << 13
"""Size of one read: each read allocates this much, and a damage inside it loses all of it. [byte]"""
BLOCK_BYTES = 1 << 23
"""Text parsed at a time: it bounds the memory, and is large enough to make the cost of calls negligible. [byte]"""


def suffix_of(path: Path) -> str:
    """Return the suffix of a file in lower case; for ``.gz``, that of the file inside."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def open_log(path: Path) -> BinaryIO:
    """Open a file outside archives for reading, and unpack it if it is gzipped."""
    return cast("BinaryIO", igzip.open(path, "rb") if path.name.lower().endswith(".gz") else path.open("rb"))


def read_undamaged(file: BinaryIO, size: int) -> tuple[bytes, Exception | None]:
    """Read up to `size` bytes; return those before any damage, and the exception, if any, that stopped the reading.

    It reads in small pieces, as a single large read would lose everything.
    """
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
    """Yield a text in pieces of about :data:`BLOCK_BYTES` that end at a line end.

    If the file is damaged, the lines before the damage are yielded first, and then its exception is raised.
    """
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
    """Return the first lines of a text file outside archives, or those before a damage, and its encoding."""
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
    return (text[: max(text.rfind("\n"), text.rfind("\r"), 0)] if len(head) == _HEAD_BYTES else text), encoding


def read_rows(file: BinaryIO | TextIO, **options: Any) -> tuple[pd.DataFrame, int]:
    """Read a CSV with options of :func:`pandas.read_csv`; return its rows, and how many too wide ones were left out."""
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always")
        rows = pd.read_csv(file, index_col=False, skipinitialspace=True, on_bad_lines="warn", **options)
    return rows, sum(str(complaint.message).count("Skipping line") for complaint in complaints)


def reason_of(error: BaseException) -> str:
    """Return one line that says what an exception of a reader means."""
    if isinstance(error, EOFError):
        return "the compressed file is cut off"
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


def is_candump(head: str, *, printed: bool = False) -> bool:
    """Check whether most of the first 50 lines are of candump, with or without ``-L``; if `printed`, only without."""
    lines = [line for line in head.splitlines() if line.strip()][:50]
    forms = (PRINTED_CANDUMP,) if printed else (PRINTED_CANDUMP, _LOGGED)
    return 2 * sum(any(form.match(line.encode()) for form in forms) for line in lines) > len(lines)


def is_bus_log(path: Path) -> bool:
    """Check whether an MDF 4 file holds frames: their channel has the name that ASAM sets, which is never compressed.

    An empty file counts as one that holds frames.
    """
    if not path.stat().st_size:
        return True
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(_FRAME_CHANNEL) >= 0


def kind_of_text(head: str, *, headed: bool = True) -> Literal["candump", "frames", "table", ""]:
    """Tell what the beginning of a text is: lines of candump, a CSV of frames, a table, or (empty) none of these.

    A text of neither candump nor frames is a table if `headed` (its suffix promises a table with a header); if not, it
    is one only if most lines below the first have several numbers.
    """
    lines = head.splitlines()
    if is_candump(head):
        return "candump"
    if any(_is_frame_header(line) for line in lines[:5]):
        return "frames"
    rows = [line for line in lines[1:50] if line.strip()]
    return "table" if headed or 2 * sum(len(_NUMBER.findall(row)) > 1 for row in rows) > len(rows) else ""


def _is_frame_header(line: str) -> bool:
    cells = {cell.strip().lower() for cell in re.split(r"[,;\t]", line)}
    return bool(cells.intersection(FRAME_COLUMNS)) and bool(cells & {"data", "databytes", "d1", "len", "dlc"})


def exists(path: Path) -> bool:
    """Check whether a file exists, alone or in an archive; LogError if it is a pipe or device."""
    archive = _archive(path)
    if archive is None and path.exists() and not (path.is_file() or path.is_dir()):
        raise LogError(f"{path}: a pipe or device, which is not read; save what it gives to a file")
    return path.is_file() if archive is None else path in files_in(archive)


def files_in(path: Path) -> list[Path]:
    """List all files in a folder, at any depth, or in an archive, except hidden ones and those in hidden folders.

    The list is empty if the path is neither a folder nor an archive.

    Raises
    ------
    LogError
        If the archive is damaged.
    """
    if path.is_dir():
        return sorted(inner for inner in path.rglob("*") if not _is_hidden(inner.relative_to(path)) and inner.is_file())
    if path.suffix.lower() != ".zip" or not path.is_file():
        return []
    try:
        with zipfile.ZipFile(path) as archive:
            names = [PurePosixPath(name) for name in archive.namelist() if not name.endswith("/")]
    except _NO_ARCHIVE as error:
        raise LogError(f"{path}: not a readable archive: {error}; pack or copy it again") from None
    return sorted(path / name for name in names if name.name and name.root == "" and not _is_hidden(name))


def _is_hidden(name: PurePath) -> bool:
    """Check whether a file, or a folder on the way to it, is hidden; ``..`` counts as hidden."""
    return any(part.startswith(".") for part in name.parts)


@contextmanager
def readable(path: Path) -> Iterator[Path]:
    """Yield a path that readers can open: the file itself, or an unpacked copy for the time of the block.

    A UserError in the block that names the copy is raised anew with `path` in its place. LogError if the file cannot be
    unpacked.
    """
    archive, packed = _archive(path), path.name.lower().endswith(".gz") and suffix_of(path) in _BINARY
    if archive is None and not packed:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="recording-") as folder:
        copy = Path(folder) / (path.name[:-3] if packed else path.name)
        try:
            with ExitStack() as opened:
                source: Any = path.open("rb") if archive is None else zipfile.ZipFile(archive)
                opened.enter_context(source)
                if archive is not None:
                    source = opened.enter_context(source.open(path.relative_to(archive).as_posix()))
                if packed:
                    source = opened.enter_context(igzip.open(source, "rb"))
                shutil.copyfileobj(source, opened.enter_context(copy.open("wb")))
        except _NO_ARCHIVE as error:
            raise LogError(f"{path}: cannot be unpacked: {str(error).strip(chr(39))}; copy the file again") from None
        with naming(str(path), copy):
            yield copy


def _archive(path: Path) -> Path | None:
    return next((parent for parent in path.parents if parent.suffix.lower() == ".zip" and parent.is_file()), None)
