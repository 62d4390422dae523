"""Files of a local folder or of object storage (a URL that fsspec knows), each written whole or not at all."""

import errno
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ecu_node.documents import write_atomically
from ecu_node.errors import UserError

__all__ = ["DISK_FULL", "Storage", "StorageError", "open_storage"]

OBJECT_STORAGE = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oci", "oss", "memory"})
"""Kinds of storage in which a file appears only when it is complete, and which need no folders."""
DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})


class StorageError(UserError):
    """A folder or object storage cannot be read or written."""


@dataclass(frozen=True, kw_only=True)
class Storage:
    """A folder of files.

    Attributes
    ----------
    url : str
        As the user named it: a path, or a URL such as ``s3://bucket/fleet``.
    """

    url: str

    @property
    def is_local(self) -> bool:
        """Whether it is a folder of this machine."""
        return "://" not in self.url

    @property
    def lasts(self) -> bool:
        """Whether what is written stays when this process ends."""
        return not self.url.startswith("memory://")

    def folder(self, name: str) -> "Storage":
        """Return a folder in this one; it is made when something is written."""
        return Storage(url=f"{self.url.rstrip('/')}/{name}")

    def names(self) -> list[str]:
        """Return the names of the files in it, sorted; none if there is no such folder. Hidden ones do not count."""
        return sorted(self._list())

    def _list(self) -> dict[str, dict[str, Any]]:
        """What the storage tells of each file, by name."""
        filesystem, root = self._filesystem()
        try:
            filesystem.invalidate_cache(root)  # others write there as well
            found = filesystem.ls(root, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except Exception as error:  # noqa: BLE001 (each kind of storage has its own)
            raise self._failed("", "read", error) from None
        named = {str(about["name"]).rstrip("/").rpartition("/")[2]: about for about in found}
        return {name: about for name, about in named.items() if not name.startswith(".")}

    def versions(self) -> dict[str, str]:
        """What tells whether a file was changed, by name: size, and time of change or tag where the storage has one."""
        marks = ("size", "mtime", "LastModified", "ETag", "etag", "created")
        return {
            name: "-".join(str(about[mark]) for mark in marks if mark in about) for name, about in self._list().items()
        }

    def read(self, name: str) -> bytes:
        """Return the content of a file.

        Raises
        ------
        StorageError
            If it is not there or cannot be read.
        """
        content = self.read_if_there(name)
        if content is None:
            raise StorageError(f"{self.url}/{name}: no such file")
        return content

    def read_if_there(self, name: str) -> bytes | None:
        """Return the content of a file; None if there is none of that name.

        Raises
        ------
        StorageError
            If it cannot be read.
        """
        filesystem, root = self._filesystem()
        try:
            content: bytes = filesystem.cat_file(f"{root}/{name}")
        except FileNotFoundError:
            return None
        except Exception as error:  # noqa: BLE001
            raise self._failed(name, "read", error) from None
        return content

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all; one of that name is replaced.

        Raises
        ------
        StorageError
            If it cannot be written.
        """
        try:
            if self.is_local:
                Path(self.url).mkdir(parents=True, exist_ok=True)
                write_atomically(Path(self.url) / name, content)
                return
            filesystem, root = self._filesystem()
            if self.url.partition("://")[0] in OBJECT_STORAGE:  # a folder made there might be a new bucket, of a slip
                filesystem.pipe_file(f"{root}/{name}", content)
            else:
                filesystem.makedirs(root, exist_ok=True)
                filesystem.pipe_file(f"{root}/.{name}", content)
                filesystem.mv(f"{root}/.{name}", f"{root}/{name}")
        except Exception as error:  # noqa: BLE001
            raise self._failed(name, "write", error) from None

    def _filesystem(self) -> tuple[Any, str]:
        """What fsspec reads and writes the storage with, and the folder's name there."""
        from fsspec.core import url_to_fs  # noqa: PLC0415 (takes time, and not every command needs it)

        try:
            filesystem, root = url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            first_line = str(error).partition("\n")[0]
            raise StorageError(f"{self.url}: no way to reach this kind of storage: {first_line}") from None
        return filesystem, str(root).rstrip("/")

    def _failed(self, name: str, what: str, error: Exception) -> StorageError:
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0] or type(error).__name__
        remedy = "; make room, and run the same command again to go on, or choose another place"
        full = getattr(error, "errno", None) in DISK_FULL
        return StorageError(f"{self.url}{name and '/'}{name}: cannot {what} it: {reason}{remedy if full else ''}")


def open_storage(place: str | Path) -> Storage:
    """Storage at a path or URL; a ``file://`` URL is a path, and paths become absolute: others may work elsewhere.

    Raises
    ------
    StorageError
        If nothing is named, which would be the folder that one happens to be in.
    """
    text = str(place).removeprefix("file://")
    if not text.strip() or text.endswith("://"):
        raise StorageError(
            f"{str(place)!r}: names no place; give the path of a folder or a URL such as s3://BUCKET/NAME"
        )
    return Storage(url=text if "://" in text else str(Path(text).absolute()))
