import errno
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import fsspec
import pytest

from calibrator.errors import FleetError
from calibrator.files import folders
from calibrator.files.storage import Storage, StorageError, open_storage, walk
from ecu_node.errors import UserError


def test_folder_that_is_not_empty_is_refused_and_unchanged(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("1")
    with pytest.raises(FleetError, match="exists and is not empty"), folders.whole_folder(tmp_path / "out"):
        pass
    assert (tmp_path / "out" / "mine").read_text() == "1"


def test_full_disk_is_reported_and_no_partial_folder_remains(tmp_path: Path) -> None:
    message = rf"^{tmp_path}/out: cannot write it: No space left on device; make room, or choose another --out"
    with pytest.raises(FleetError, match=message), folders.whole_folder(tmp_path / "out"):
        raise OSError(errno.ENOSPC, "Error writing bytes to file. Detail: [errno 28] No space left on device")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["out", "out[1]"])
def test_partial_folder_of_a_killed_process_is_removed(tmp_path: Path, name: str) -> None:
    gone = subprocess.Popen([sys.executable, "-c", "pass"])
    gone.wait()
    (tmp_path / f".{name}.partial-{gone.pid}").mkdir()
    (tmp_path / f".{name}.partial-1").mkdir()
    with folders.whole_folder(tmp_path / name):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [f".{name}.partial-1", name]


@pytest.mark.parametrize("require", [folders.require_new_folder, folders.require_possible_folder])
@pytest.mark.parametrize("name", ["x", "x/y/z"])
def test_folder_in_an_unwritable_file_system_is_refused(require: Callable[[Path], None], name: str) -> None:
    # Permissions do not stop root, so only an attempt shows it.
    with pytest.raises(FleetError, match=rf"^/proc/{name}: nothing can be made in /proc: .*; choose another folder$"):
        require(Path("/proc") / name)


@pytest.mark.parametrize(
    "require", [folders.require_new_folder, folders.require_possible_folder, folders.require_possible_file]
)
def test_url_is_refused_where_only_a_path_can_be_written(require: Callable[[Path], None]) -> None:
    """Otherwise a local folder ``s3:`` would be made."""
    with pytest.raises(FleetError, match=r"^s3:/bucket/result: is a URL; name a folder of this machine"):
        require(Path("s3://bucket/result"))


def test_symbolic_link_is_not_replaced_by_a_folder(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "there")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("out", "dangling"):
        with pytest.raises(FleetError, match=f"{name}: is a link"):
            folders.require_new_folder(tmp_path / name)
    folders.require_possible_folder(tmp_path / "out")
    with pytest.raises(FleetError, match="choose another"):
        folders.require_possible_folder(tmp_path / "dangling")


def fill_while_the_place_is_taken(out: Path) -> None:
    with folders.whole_folder(out) as folder:
        (folder / "result").write_text("hours of work")
        out.mkdir()
        (out / "in the way").write_text("")


def test_error_says_where_the_new_result_is_if_it_cannot_be_moved_into_place(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"out: cannot be replaced: .*; what was made stands in") as caught:
        fill_while_the_place_is_taken(tmp_path / "out")
    kept = Path(str(caught.value).rpartition("stands in ")[2])
    assert (kept / "result").read_text() == "hours of work"


def test_mount_point_is_refused_as_a_new_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "is_mount", lambda _: True)
    with pytest.raises(FleetError, match="a disk is mounted there"):
        folders.require_new_folder(tmp_path)


def test_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "old").write_bytes(b"old")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=f"^{tmp_path}/folder: cannot be written: Is a directory; "):
        folders.write_files({tmp_path / "folder": b""})

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ecu_node.documents.os.fsync", full)
    with pytest.raises(UserError, match=f"^{tmp_path}/old: cannot be written: No space left on device; "):
        folders.write_files({tmp_path / "old": b"new"})
    assert sorted(tmp_path.iterdir()) == [tmp_path / "folder", tmp_path / "old"]
    assert (tmp_path / "old").read_bytes() == b"old"


# Places that cannot be used are reported in one line


@pytest.mark.parametrize("place", ["", " ", "file://", "s3://"])
def test_empty_path_or_url_is_refused(place: str) -> None:
    with pytest.raises(StorageError, match=f"^{place!r}: names no place; give the path of a folder or a URL"):
        open_storage(place)


def test_unknown_kind_of_storage_is_refused() -> None:
    with pytest.raises(StorageError, match=r"^nokind://x: no way to reach this kind of storage: "):
        open_storage("nokind://x").names()


def test_unreadable_inner_folder_is_reported_and_others_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    found = [Path(folder.url).name for folder, _ in walk(open_storage(tmp_path), problems)]
    assert found == ["V1", "vehicle 2"]
    assert problems == ["lost+found: cannot read it: Permission denied"]


def test_folder_on_a_file_system_without_locks_is_usable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(handle: int, operation: int) -> None:
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr("calibrator.files.storage.fcntl.flock", no_locks)
    with open_storage(tmp_path).locked():
        pass


@pytest.mark.parametrize(("place", "error", "words"), [
    ("memory://x", OSError(errno.ENOSPC, "No space left on device"), "on device; make room, and run the same command"),
    ("memory://x", RuntimeError("Unable to locate credentials"), "credentials; check the credentials, "),
    ("/x", PermissionError(errno.EACCES, "Permission denied"), "denied; see that you may read it$"),
])  # fmt: skip
def test_failure_of_storage_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, place: str, error: Exception, words: str
) -> None:
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr(type(fsspec.url_to_fs(place)[0]), "open", failing)
    expected = f"^{place}/y: cannot read it: .*{words}"
    with pytest.raises(StorageError, match=expected), open_storage(place).opened("y"):
        pass
