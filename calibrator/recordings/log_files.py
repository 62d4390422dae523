"""Files of recordings: alone, in folders, in ``.zip`` archives, gzipped.

A file inside an archive has the path ``fleet.zip/V0001/monday.log``, as if the archive were a folder.
"""

import gzip
import io
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO, cast

from calibrator.errors import LogError
from ecu_node.errors import UserError

__all__ = ["UNREADABLE", "exists", "file_on_disk", "files_in", "head_of", "opened", "readable", "suffix_of"]

UNREADABLE = (OSError, EOFError, zlib.error)
"""What opening and unpacking may raise; gzip.BadGzipFile is an OSError."""
_BINARY = (".mf4", ".parquet", ".feather", ".arrow")
"""Formats whose readers need a file that is not packed."""


def suffix_of(path: Path) -> str:
    """Suffix of a file, lower case, that of the packed one for ``.gz``."""
    return Path(path.name.lower().removesuffix(".gz")).suffix


def opened(path: Path) -> BinaryIO:
    """Open a file that is in no archive, gzipped or not."""
    return cast("BinaryIO", gzip.open(path, "rb") if path.name.lower().endswith(".gz") else path.open("rb"))


def head_of(path: Path, size: int) -> bytes:
    """Beginning of a file that is in no archive; of a damaged one what can be read."""
    parts: list[bytes] = []
    with opened(path) as file:
        try:
            while size > 0 and (part := cast("io.BufferedIOBase", file).read1(size)):
                parts.append(part)
                size -= len(part)
        except UNREADABLE:
            if not parts:
                raise
    return b"".join(parts)


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
            names = [PurePosixPath(item.filename) for item in archive.infolist() if not item.is_dir()]
    except (*UNREADABLE, zipfile.BadZipFile) as error:
        raise LogError(f"{path}: not a readable archive: {error}; pack or copy it again") from None
    return sorted(path / name for name in names if name.name[0] != "." and ".." not in name.parts and name.root == "")


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
                with opened(path) as packed, copy.open("wb") as file:
                    shutil.copyfileobj(packed, file)
            else:
                with zipfile.ZipFile(archive) as members, copy.open("wb") as file:
                    shutil.copyfileobj(members.open(path.relative_to(archive).as_posix()), file)
        except (*UNREADABLE, zipfile.BadZipFile, RuntimeError, KeyError) as error:  # RuntimeError: it is encrypted
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
