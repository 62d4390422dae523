"""``calibrator sign``, interrupted: the same command, run again, goes on, and nothing of the first run stays beside."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from calibrator.signing.key_files import read_signer
from calibrator.signing.orders import Order
from ecu_node.parameters import VehicleParameters, write_parameters
from ecu_node.trust.statements import SignedParameters, open_statement
from tests.trust.signing import Run
from tests.trust.signing_steps import by, require_one_line

MANY = 400


@pytest.fixture
def many(parameters: VehicleParameters, tmp_path: Path) -> list[Path]:
    """Parameter files of three vehicles."""
    paths = [tmp_path / "params" / f"V{number}.json" for number in range(3)]
    paths[0].parent.mkdir()
    for path in paths:
        write_parameters(replace(parameters, vehicle=path.stem), path)
    return paths


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def kept(done: tuple[int, str, str]) -> str:
    assert done[0] == 0, done
    return done[2].removeprefix("notice: ").partition(" were signed before")[0]


@pytest.mark.parametrize("options", [[], ["--sequence", "7"], ["--days", "30", "--allow-large-step"]])
def test_the_same_command_keeps_what_is_signed_and_signs_the_rest(
    options: list[str], calibrator: Run, keys: Path, many: list[Path], tmp_path: Path
) -> None:
    sign = ["sign", *many, *by(keys, "ab"), *options, "--out", tmp_path / "signed"]
    first = calibrator(*sign)
    assert (first[0], first[2]) == (0, "")
    before = contents(tmp_path / "signed")
    (tmp_path / "signed" / "V1.json").unlink()
    again = calibrator(*sign)
    assert kept(again) == "2 of 3"
    assert again[1] == first[1], "all files are named, as if it had not been interrupted"
    after = contents(tmp_path / "signed")
    assert after.keys() == before.keys()
    assert [name for name in after if after[name] != before[name]] in ([], ["V1.json"])
    assert kept(calibrator(*sign)) == "3 of 3"
    assert calibrator(*sign, "--replace")[2] == ""


def test_the_same_command_of_a_second_signer_goes_on(
    calibrator: Run, keys: Path, many: list[Path], tmp_path: Path
) -> None:
    assert calibrator("sign", *many, *by(keys, "a"), "--out", tmp_path / "by-a")[0] == 0
    sign = ["sign", *sorted((tmp_path / "by-a").iterdir()), *by(keys, "b"), "--out", tmp_path / "signed"]
    assert calibrator(*sign)[0] == 0
    before = contents(tmp_path / "signed")
    (tmp_path / "signed" / "V0.json").unlink()
    assert kept(calibrator(*sign)) == "2 of 3"
    assert contents(tmp_path / "signed") == before


@pytest.mark.parametrize(
    "change",
    [
        lambda command: [*command, "--days", "30"],
        lambda command: [*command, "--allow-large-step"],
        lambda command: [*command, "--sequence", "7"],
        lambda command: command[:-2],  # by a alone
    ],
)
def test_what_another_command_signed_is_not_kept(
    change: Callable[[list[object]], list[object]], calibrator: Run, keys: Path, many: list[Path], tmp_path: Path
) -> None:
    sign = ["sign", *many, "--out", tmp_path / "signed", *by(keys, "ab")]
    assert calibrator(*sign)[0] == 0
    before = contents(tmp_path / "signed")
    require_one_line(calibrator(*change(sign)), f"{tmp_path}/signed/V0.json: there is a file already")
    assert contents(tmp_path / "signed") == before


def test_a_file_of_other_parameters_or_a_damaged_one_is_not_kept(
    calibrator: Run, keys: Path, parameters: VehicleParameters, many: list[Path], tmp_path: Path
) -> None:
    sign = ["sign", *many, *by(keys, "a"), "--out", tmp_path / "signed"]
    assert calibrator(*sign)[0] == 0
    whole = (tmp_path / "signed" / "V2.json").read_bytes()
    (tmp_path / "signed" / "V2.json").write_bytes(whole[:-10])
    require_one_line(calibrator(*sign), f"{tmp_path}/signed/V2.json: there is a file already")
    (tmp_path / "signed" / "V2.json").write_bytes(whole)
    write_parameters(replace(parameters, vehicle="V1", number=301), many[1])
    require_one_line(calibrator(*sign), f"{tmp_path}/signed/V1.json: there is a file already")


@pytest.mark.parametrize(("hours", "is_done"), [(-1, False), (0, True), (23, True), (24, False)])
def test_after_a_day_a_file_is_to_be_signed_anew(
    hours: int, is_done: bool, keys: Path, params: Path, tmp_path: Path
) -> None:
    begun = datetime(2026, 6, 1, 12, tzinfo=UTC)
    signers = [read_signer(keys / "a.key", None)]
    first, later = (
        Order(signers=signers, now=now, sequence=None, days=None, allow_large_step=False)
        for now in (begun, begun + timedelta(hours=hours))
    )
    (tmp_path / "signed.json").write_bytes(first.signed(params))
    assert later.is_done(params, tmp_path / "signed.json") is is_done


def test_a_signer_who_is_killed_leaves_nothing_that_the_next_run_does_not_remove(
    keys: Path, parameters: VehicleParameters, tmp_path: Path
) -> None:
    (tmp_path / "params").mkdir()
    paths = [tmp_path / "params" / f"V{number}.json" for number in range(MANY)]
    write_parameters(parameters, paths[0])
    for path in paths[1:]:
        shutil.copy(paths[0], path)
    out = tmp_path / "signed"
    command = [sys.executable, "-m", "calibrator", "sign", *paths, *by(keys, "a"), "--out", out]
    running = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    while running.poll() is None and not (out.is_dir() and len(list(out.iterdir())) > 10):
        time.sleep(0.001)
    running.kill()
    running.communicate(timeout=60)
    left = {path.name for path in out.iterdir()}
    assert 10 < len(left) < MANY, "it was killed at work"
    gone = out / f".V5.json.partial-{running.pid}"
    gone.write_bytes(b"{")
    mine, others = out / f".V6.json.partial-{os.getpid()}", out / f".other.partial-{running.pid}"
    mine.touch()
    others.touch()
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1].startswith("notice: ")
    assert {path.name for path in out.iterdir()} == {path.name for path in [*paths, mine, others]}
    for path in paths:
        _, statement = open_statement((out / path.name).read_bytes(), "f")
        assert isinstance(statement, SignedParameters)


def test_a_link_is_not_replaced(calibrator: Run, keys: Path, params: Path, tmp_path: Path) -> None:
    link = tmp_path / "signed" / "v1.json"
    link.parent.mkdir()
    revoke = ["revoke", "--vehicle", "v1", "--number", 5, "--why", "w", *by(keys, "a"), "--out", link]
    make = ["keys", "set", keys / "a.pub", "--threshold", 1, "--out", link]
    sign = ["sign", params, *by(keys, "a"), "--out", link.parent]
    for target in (tmp_path / "nowhere", tmp_path / "there"):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        for command in (revoke, make, sign, [*sign, "--replace"]):
            require_one_line(calibrator(*command), f"{link}: is a link, so it cannot be replaced")
        (tmp_path / "there").write_bytes(b"mine")
    assert link.is_symlink()
    assert (tmp_path / "there").read_bytes() == b"mine"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
def test_what_is_no_file_is_not_replaced(
    make: Callable[[Path], object], calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    place = tmp_path / "signed" / "v1.json"
    place.parent.mkdir()
    make(place)
    done = calibrator("sign", params, *by(keys, "a"), "--out", place.parent, "--replace")
    require_one_line(done, f"{place}: is ")
    assert not place.is_file()
