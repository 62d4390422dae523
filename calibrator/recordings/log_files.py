"""Files of recordings: alone, in folders, in ``.zip`` archives, gzipped; and what kind of recording one is.

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
from typing import Any, BinaryIO, TextIO, cast

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
    "is_table",
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
"""What opening and unpacking may raise; gzip.BadGzipFile is an OSError."""
_NO_ARCHIVE = (*UNREADABLE, zipfile.BadZipFile, UnicodeError, RuntimeError, KeyError)
"""What opening and unpacking an archive may raise; RuntimeError where it is encrypted."""
_BINARY = (".mf4", ".parquet", ".feather", ".arrow")
"""Formats whose readers need a file that is not packed."""
PRINTED_CANDUMP = re.compile(
    rb"^[ \t]*(?:\((?P<time>[-\d:. ]+)\)[ \t]+)?(?P<channel>[\w.-]+)[ \t]+(?:[RT]X [-B] [-E][ \t]+)?"
    rb"(?P<id>[\dA-F]{8}|[\dA-F]{3})[ \t]+\[(?P<length>\d+)\](?:[ \t]+(?P<remote>remote request)|[ \t]+(?P<data>"
    rb"(?:[\dA-F]{2} ?)*))[^\r\n]*",
    re.MULTILINE | re.IGNORECASE,
)
"""A line as candump prints it without ``-L``."""
_LOGGED = re.compile(rb"\(\d+\.\d+\) \S+ [\dA-Fa-f]{3,8}#")
TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".parquet", ".feather", ".arrow", ".mf4")
FRAME_COLUMNS = ("arbitration_id", "id", "canid", "can id")
"""Headers of identifiers, lower case: a text file that has one of them beside a time is a log of CAN frames."""
_FRAME_CHANNEL = bytes(8) + b"CAN_DataFrame\0"
"""A block of text begins with its count of links, which is 0, then comes the text."""
_HEAD_BYTES = 1 << 16
_READ_BYTES = 1 << 13
"""Asked for at a time: room for all of it is made for each piece that comes, and a damage takes it along. [byte]"""
BLOCK_BYTES = 1 << 23
"""Text parsed at a time: bounds the memory, large enough for calls not to count. [byte]"""


def suffix_of(path: Path) -> str:
    """Suffix of a file, lower case, that of the packed one for ``.gz``."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def open_log(path: Path) -> BinaryIO:
    """Open a file that is in no archive, gzipped or not."""
    return cast("BinaryIO", igzip.open(path, "rb") if path.name.lower().endswith(".gz") else path.open("rb"))


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


def is_candump(head: str, *, printed: bool = False) -> bool:
    """Whether a text begins with lines of candump; with `printed`, as it prints them without ``-L``."""
    lines = [line for line in head.splitlines() if line.strip()][:50]
    forms = (PRINTED_CANDUMP,) if printed else (PRINTED_CANDUMP, _LOGGED)
    return 2 * sum(any(form.match(line.encode()) for form in forms) for line in lines) > len(lines)


def is_bus_log(path: Path) -> bool:
    """Whether an MDF 4 file holds frames: ASAM's name of their channel is a text in it, which is never compressed."""
    if not path.stat().st_size:
        return True
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(_FRAME_CHANNEL) >= 0


def is_table(path: Path) -> bool:
    """Whether a file is a table: by its suffix, and where logs of frames have the same one, by what is in it."""
    suffix = suffix_of(path)
    if suffix == ".zip" or path.is_dir():
        return any(is_table(file) for file in files_in(path)[:1])
    if suffix not in TABLE_SUFFIXES or not exists(path):
        return False
    try:
        with readable(path) as file:
            if suffix == ".mf4":
                return not is_bus_log(file)
            if suffix in {".csv", ".tsv", ".txt"}:
                head = text_head(file)[0]
                return not is_candump(head) and not any(_is_frame_header(line) for line in head.splitlines()[:5])
    except UNREADABLE:
        return suffix != ".txt"
    return True


def _is_frame_header(line: str) -> bool:
    cells = {cell.strip().lower() for cell in re.split(r"[,;\t]", line)}
    return bool(cells.intersection(FRAME_COLUMNS)) and bool(cells & {"data", "databytes", "d1", "len", "dlc"})


def exists(path: Path) -> bool:
    """Whether there is such a file, alone or in an archive."""
    archive = _archive(path)
    return path.is_file() if archive is None else path in files_in(archive)


def files_in(path: Path) -> list[Path]:
    """All files in a folder, at any depth, or in an archive, but hidden ones and those in hidden folders.

    None for another file.

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
    """Whether a file or a folder on the way to it is hidden; ``..`` counts as such."""
    return any(part.startswith(".") for part in name.parts)


@contextmanager
def readable(path: Path) -> Iterator[Path]:
    """A file that can be read by its path: the file itself, or a copy out of an archive.

    Errors of the user that name the copy come out with the path that the user knows.
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
