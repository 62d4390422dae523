"""Files that a user names: what is no regular file, or too large, is refused before anybody waits for its end."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.ecu_node.vehicles import LAYOUT, SMALL_LAYOUT


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)  # sparse: no disk is filled


KINDS = [(pipe, "it is a pipe; a file is expected"), (endless, "it is a device; a file is expected"),
         (Path.mkdir, "it is a folder; a file is expected"), (huge, "it is larger than [0-9]+ bytes")]  # fmt: skip


def checked(params: Path, layout: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ecu_node", "check", "--params", str(params), "--layout", str(layout)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(("make", "words"), KINDS)
@pytest.mark.parametrize("role", ["layout", "dbc"])
def test_a_layout_or_dbc_that_is_no_file_is_one_line(
    tmp_path: Path, make: Callable[[Path], None], words: str, role: str
) -> None:
    (tmp_path / "small.toml").write_text(SMALL_LAYOUT)
    name = "small.dbc" if role == "dbc" else "other.toml"
    make(tmp_path / name)
    done = checked(tmp_path / "p.json", tmp_path / ("small.toml" if role == "dbc" else name))
    what = {"dbc": "DBC", "layout": "layout"}[role]
    assert re.match(rf"ecu-node: .*{name}: cannot read the {what}: {words}", done.stderr)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)


@pytest.mark.parametrize(("make", "words"), KINDS)
def test_a_parameter_file_that_is_none_is_malformed(tmp_path: Path, make: Callable[[Path], None], words: str) -> None:
    make(tmp_path / "p.json")
    done = checked(tmp_path / "p.json", LAYOUT)
    assert re.match(rf"NOT FIT \(MALFORMED_PARAMETERS\): .*p\.json: not a parameter file: {words}", done.stdout)
    assert (done.returncode, done.stderr) == (1, "")
