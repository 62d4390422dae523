"""Files that a user names: what is no regular file, or too large, is refused before anybody waits for its end."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from ecu_node.cli import run_ecu_node
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


@pytest.mark.parametrize(("make", "words"), KINDS)
@pytest.mark.parametrize(
    ("role", "said"),
    [
        ("small.dbc", "ecu-node: .*small.dbc: cannot read the DBC: "),
        ("other.toml", "ecu-node: .*other.toml: cannot read the layout: "),
        ("p.json", r"NOT FIT \(MALFORMED_PARAMETERS\): .*p\.json: not a parameter file: "),
    ],
)
def test_input_that_is_not_a_regular_file_is_reported_in_one_line(
    tmp_path: Path, make: Callable[[Path], None], words: str, role: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path / role)
    (tmp_path / "small.toml").write_text(SMALL_LAYOUT)
    layout = {"small.dbc": tmp_path / "small.toml", "other.toml": tmp_path / role}.get(role, LAYOUT)
    code = run_ecu_node(["check", "--params", str(tmp_path / "p.json"), "--layout", str(layout)])
    out, err = capsys.readouterr()
    found, silent = (out, err) if role == "p.json" else (err, out)
    assert re.match(said + words, found)
    assert (code, silent) == (1, "")
    assert role == "p.json" or found.count("\n") == 1
