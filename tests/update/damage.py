"""Kinds of damage to a file."""

import os
from pathlib import Path


def without(path: Path) -> None:
    path.unlink()


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def a_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def huge(path: Path) -> None:
    os.truncate(path, 1 << 30)


def zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))
