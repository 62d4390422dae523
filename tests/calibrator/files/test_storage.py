"""Places that cannot be used are told in one line."""

import errno
import os
from contextlib import nullcontext
from pathlib import Path

import fsspec
import pytest

from calibrator.files.storage import Storage, StorageError, open_storage, walk


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


def test_a_file_that_vanishes_while_its_folder_is_listed_hides_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").touch()

    class Vanishing:
        """What os.scandir yields, of a file that another process removes."""

        name = "gone"
        is_dir, is_file = staticmethod(lambda: False), staticmethod(lambda: True)

        def stat(self) -> None:
            raise FileNotFoundError

    with os.scandir(tmp_path) as entries:
        listed = [Vanishing(), *entries]
    monkeypatch.setattr("calibrator.files.storage.os.scandir", lambda _: nullcontext(listed))
    assert open_storage(tmp_path).names() == ["there"]


def test_an_inner_folder_that_cannot_be_read_is_a_problem_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("V1", "lost+found", "vehicle 2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.log").touch()
    contents = Storage.contents

    def denied(storage: Storage, prefix: str = "") -> object:
        if storage.url.endswith("lost+found"):
            raise StorageError("lost+found: cannot read it: Permission denied")
        return contents(storage, prefix)

    monkeypatch.setattr(Storage, "contents", denied)
    problems: list[str] = []
    assert [folder.url for folder, _ in walk(open_storage(tmp_path), problems)] == [
        str(tmp_path / "V1"),
        str(tmp_path / "vehicle 2"),
    ]
    assert problems == ["lost+found: cannot read it: Permission denied"]


def test_a_folder_on_a_disk_without_locks_is_used_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(handle: int, operation: int) -> None:
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr("calibrator.files.storage.fcntl.flock", no_locks)
    with open_storage(tmp_path).locked():
        pass


def test_storage_that_lets_nobody_in_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_credentials(*_: object) -> None:
        raise RuntimeError("Unable to locate credentials")

    monkeypatch.setattr(fsspec.get_filesystem_class("memory"), "open", no_credentials)
    expected = r"^memory://x/y: cannot read it: Unable to locate credentials; check the credentials, "
    with pytest.raises(StorageError, match=expected), open_storage("memory://x").opened("y"):
        pass
