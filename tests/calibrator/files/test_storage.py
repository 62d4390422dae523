"""Places that cannot be used are told in one line."""

import errno
from pathlib import Path

import pytest

from calibrator.files.storage import StorageError, open_storage


@pytest.mark.parametrize("place", ["", " ", "file://", "s3://"])
def test_no_place_is_refused(place: str) -> None:
    with pytest.raises(StorageError, match=f"^{place!r}: names no place; give the path of a folder or a URL"):
        open_storage(place)


def test_full_disk_is_told_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("calibrator.files.storage.write_atomically", full)
    expected = rf"^{tmp_path}/x: cannot write it: No space left on device; make room, and run the same command again"
    with pytest.raises(StorageError, match=expected):
        open_storage(tmp_path).write("x", b"")


def test_unknown_kind_of_storage_is_refused() -> None:
    with pytest.raises(StorageError, match=r"^nokind://x: no way to reach this kind of storage: "):
        open_storage("nokind://x").names()
