"""Read and write files in a local folder or in object storage (a URL that fsspec knows), each whole or not at all."""

import errno
import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from calibrator.errors import naming
from ecu_node.documents import write_atomically
from ecu_node.errors import UserError

__all__ = [
    "DISK_FULL",
    "Entry",
    "Storage",
    "StorageError",
    "is_url",
    "local_copy",
    "open_storage",
    "walk",
]

OBJECT_STORAGE = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oci", "oss", "memory"})
"""URL schemes of storage in which a file appears only when it is complete, and which needs no folders."""
DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})


class StorageError(UserError):
    """A folder or object storage cannot be read or written."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A file as its folder lists it.

    Attributes
    ----------
    name : str
        Name without the folder.
    size : int
        Size of the file. [byte]
    version : str
        Text that changes when the file changes: its size, and the time of its last change or the storage's equivalent.
    """

    name: str
    size: int
    version: str


@dataclass(frozen=True, kw_only=True)
class Storage:
    """A folder of files, on this machine or in object storage; it need not exist yet.

    Attributes
    ----------
    url : str
        Absolute path, or a URL such as ``s3://bucket/fleet``.
    """

    url: str

    @property
    def is_local(self) -> bool:
        """Whether it is a folder of this machine."""
        return not is_url(self.url)

    def folder(self, name: str) -> "Storage":
        """Return a folder in this one; it is created when a file is first written into it."""
        return Storage(url=f"{self.url.rstrip('/')}/{name}")

    def contents(self, prefix: str = "") -> tuple[list[str], list[Entry]]:
        """Return the names of the inner folders, and the files, both sorted; none if this folder does not exist.

        Hidden folders and files are left out, and so are those whose names do not begin with `prefix`.
        """
        folders, files = list[str](), list[Entry]()
        with self._reporting("", "read"), suppress(FileNotFoundError, NotADirectoryError):
            for found in self._here(prefix) if self.is_local else self._there(prefix):
                if isinstance(found, Entry):
                    files.append(found)
                else:
                    folders.append(found)
        return sorted(folders), sorted(files, key=lambda entry: entry.name)

    def _here(self, prefix: str) -> Iterator[Entry | str]:
        """Yield the files of a folder of this machine, and the names of its folders."""
        with os.scandir(self.url) as items:
            for item in items:
                if item.name.startswith(".") or not item.name.startswith(prefix):
                    continue
                if item.is_dir():
                    yield item.name
                elif item.is_file():
                    with suppress(FileNotFoundError):  # another process may have just removed it
                        status = item.stat()
                        yield Entry(item.name, status.st_size, f"{status.st_size}-{status.st_mtime_ns}")

    def _there(self, prefix: str) -> Iterator[Entry | str]:
        """Yield the files of a folder in object storage, and the names of its folders."""
        filesystem, root = self._filesystem()
        if prefix and self.url.startswith(("s3", "gs", "gcs")):  # these list by prefix in one request
            listed = filesystem.find(root, prefix=prefix, maxdepth=1, detail=True).values()
        else:
            listed = filesystem.ls(root, detail=True)
        for about in listed:
            path = str(about["name"]).rstrip("/")
            name = path.rpartition("/")[2]
            if name.startswith(".") or not name.startswith(prefix) or path == root:
                continue
            if about["type"] == "directory":
                yield name
            else:
                marks = [about[key] for key in ("mtime", "ETag", "etag", "LastModified", "created") if key in about]
                version = "-".join(map(str, [about["size"], *marks[:1]]))
                yield Entry(name, int(about["size"] or 0), version)

    def names(self, prefix: str = "") -> list[str]:
        """Return the names of files and folders that begin with `prefix`, sorted."""
        folders, files = self.contents(prefix)
        return sorted([*folders, *(entry.name for entry in files)])

    def read(self, name: str) -> bytes:
        """Return the content of a file; StorageError if it is not there or cannot be read."""
        content = self.read_if_there(name)
        if content is None:
            raise StorageError(f"{self.url}/{name}: no such file")
        return content

    def read_if_there(self, name: str) -> bytes | None:
        """Return the content of a file, None if there is none; StorageError if it cannot be read."""
        with self._reporting(name, "read"), suppress(FileNotFoundError, NotADirectoryError):
            filesystem, root = self._filesystem()
            content: bytes = filesystem.cat_file(f"{root}/{name}")
            return content
        return None

    @contextmanager
    def opened(self, name: str) -> Iterator[BinaryIO | None]:
        """Open a file to read parts of it; None if there is none, StorageError if it cannot be opened."""
        file = None
        with self._reporting(name, "read"), suppress(FileNotFoundError):
            filesystem, root = self._filesystem()
            file = filesystem.open(f"{root}/{name}", "rb")
        with file or nullcontext() as opened:
            yield opened

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all, in place of any older one; StorageError if it cannot be written."""
        with self._reporting(name, "write"):
            if self.is_local:
                Path(self.url).mkdir(parents=True, exist_ok=True)
                write_atomically(Path(self.url) / name, content)
                return
            filesystem, root = self._filesystem()
            if self.url.partition("://")[0] in OBJECT_STORAGE:  # making a folder there could create a bucket by mistake
                filesystem.pipe_file(f"{root}/{name}", content)
            else:
                filesystem.makedirs(root, exist_ok=True)
                filesystem.pipe_file(f"{root}/.{name}", content)
                filesystem.mv(f"{root}/.{name}", f"{root}/{name}")

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with self._reporting(name, "remove"), suppress(FileNotFoundError):
            filesystem, root = self._filesystem()
            filesystem.rm_file(f"{root}/{name}")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold a lock against other processes of this machine; without effect in object storage and on NFS."""
        if not self.is_local:
            yield
            return
        handle = os.open(self.url, os.O_RDONLY | os.O_DIRECTORY)
        try:
            with suppress(OSError):  # NFS, for one, locks no folders
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)

    def _filesystem(self) -> tuple[Any, str]:
        """Return the file system of fsspec for this storage, and the folder's name in it."""
        from fsspec.core import url_to_fs  # noqa: PLC0415 (takes time, and not every command needs it)

        try:
            filesystem, root = url_to_fs(self.url, **({} if self.is_local else {"use_listings_cache": False}))
        except (ImportError, ValueError) as error:
            first_line = str(error).partition("\n")[0]
            raise StorageError(f"{self.url}: no way to reach this kind of storage: {first_line}") from None
        return filesystem, str(root).rstrip("/")

    @contextmanager
    def _reporting(self, name: str, what: str) -> Iterator[None]:
        """Turn any exception in the block into a StorageError: cannot `what` (read, say) the file `name`, and why."""
        try:
            yield
        except StorageError:
            raise
        except Exception as error:  # noqa: BLE001 (each kind of storage has its own)
            reason = getattr(error, "strerror", None) or str(error).partition("\n")[0] or type(error).__name__
            remedy = ""
            if getattr(error, "errno", None) in DISK_FULL:
                remedy = "; make room, and run the same command again to go on, or choose another place"
            elif not self.is_local:
                remedy = (
                    "; check the credentials, the address of the storage, the bucket, and what this user may do there"
                )
            elif what == "write":
                remedy = "; choose another folder"
            elif isinstance(error, PermissionError):
                remedy = "; see that you may read it"
            raise StorageError(f"{self.url}{name and '/'}{name}: cannot {what} it: {reason}{remedy}") from None


def is_url(place: str) -> bool:
    """Check whether a place is a URL, in object storage or on another machine."""
    return "://" in place


def open_storage(place: str | Path) -> Storage:
    """Return the storage at a path or URL; a ``file://`` URL counts as a path.

    Paths become absolute, because worker processes may run in another folder.

    Raises
    ------
    StorageError
        If the text names no place: it is empty, which would otherwise mean the current folder, or only ``s3://``.
    """
    text = str(place).removeprefix("file://")
    if not text.strip() or text.endswith("://"):
        raise StorageError(
            f"{str(place)!r}: names no place; give the path of a folder or a URL such as s3://BUCKET/NAME"
        )
    return Storage(url=text if is_url(text) else str(Path(text).absolute()))


def walk(
    storage: Storage, problems: list[str], *, above: frozenset[str] = frozenset()
) -> Iterator[tuple[Storage, list[Entry]]]:
    """Yield each folder that holds files, at any depth, with its files; a folder is listed just before it is yielded.

    If an inner folder cannot be read, the reason is added to `problems`, and the walk goes on; StorageError if
    `storage` itself cannot be read. Links are followed, except those that lead back to a folder above.
    """
    place = os.path.realpath(storage.url) if storage.is_local else storage.url
    if place in above:
        return
    folders, files = storage.contents()
    if files:
        yield storage, files
    for name in folders:
        try:
            yield from walk(storage.folder(name), problems, above=above | {place})
        except StorageError as error:
            problems.append(str(error))


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """Yield a file on this machine: the file itself, or a temporary copy of a remote one for the time of the block."""
    if not is_url(url):
        yield Path(url)
        return
    folder, _, name = url.rpartition("/")
    storage = Storage(url=folder)
    with tempfile.TemporaryDirectory(prefix="copy-") as temporary:
        copy = Path(temporary) / name
        with storage._reporting(name, "read"):
            filesystem, root = storage._filesystem()
            filesystem.get_file(f"{root}/{name}", str(copy))
        with naming(url, copy):
            yield copy
