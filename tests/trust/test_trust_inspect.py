"""``ecu-node inspect``: what is wrong with a state or a file is said, and the exit code tells it too."""

import shutil
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.trust import commands
from ecu_node.trust.activation import accept
from ecu_node.trust.canonical import canonical_bytes
from tests.trust.damage import a_folder, cut, without, zeros
from tests.trust.signing import Run, Signers, time_text

DAY = timedelta(days=1)


def line_of(out: str, begin: str) -> str:
    (line,) = [line for line in out.splitlines() if line.startswith(begin)]
    return line


def test_a_state_is_shown_with_the_times_for_which_its_sets_hold(two_slots: Path, now: datetime, run: Run) -> None:
    code, out, err = run("inspect", two_slots)
    assert (code, err) == (0, "")
    (begin, end) = (time_text(now - DAY), time_text(now + 364 * DAY))
    for slot in ("slot a: number 5, in force before", "slot b: number 6, in force"):
        found = line_of(out, f"{slot}; parameter set 300, holds from ")
        assert found[-44:-20] == f"{found[-44:-24]} to "
        assert begin[:13] in found
        assert end[:13] in found


@pytest.mark.parametrize("damage", [without, cut, zeros, a_folder])
def test_a_damaged_slot_is_told_and_is_an_error_where_it_is_in_force(
    damage: Callable[[Path], None], two_slots: Path, run: Run
) -> None:
    damage(two_slots / "slot-a.json")
    code, out, err = run("inspect", two_slots)
    assert (code, err) == (0, ""), "what was in force before is not used now"
    assert line_of(out, "slot a") == "slot a: number 5, in force before; damaged, it is not used"
    damage(two_slots / "slot-b.json")
    code, out, err = run("inspect", two_slots)
    assert (code, len(err.splitlines())) == (1, 1)
    assert err.startswith(f"ecu-node: {two_slots}/slot-b.json: ")
    assert line_of(out, "slot b") == "slot b: number 6, in force; damaged, it is not used"


def test_a_whole_set_in_the_place_of_another_is_damage(two_slots: Path, run: Run) -> None:
    shutil.copyfile(two_slots / "slot-a.json", two_slots / "slot-b.json")
    code, out, err = run("inspect", two_slots)
    assert (code, "not what was accepted" in err) == (1, True)
    assert line_of(out, "slot b").endswith("damaged, it is not used")


@pytest.mark.parametrize(
    ("days", "word", "why"), [(400, "expired", "expired at"), (-2, "does not hold yet", "is the clock set?")]
)
def test_a_set_that_does_not_hold_now_is_an_error_in_force_and_on_trial(
    days: int,
    word: str,
    why: str,
    two_slots: Path,
    signers: Signers,
    parameters: VehicleParameters,
    database: VehicleDatabase,
    now: datetime,
    monkeypatch: pytest.MonkeyPatch,
    run: Run,
) -> None:
    accept(two_slots, signers.parameters(parameters, 7, not_before=now - DAY), "f", database, now)
    monkeypatch.setattr(commands, "_now", lambda: now + days * DAY)
    code, out, err = run("inspect", two_slots)
    assert (code, [why in line for line in err.splitlines()]) == (1, [True, True])
    for slot in ("slot a: number 7, on trial", "slot b: number 6, in force"):
        assert line_of(out, slot).endswith(f"Z; {word}, it is not used")


def test_files_that_nobody_signed_are_told(
    params: Path, keys: Path, in_force: Path, signers: Signers, tmp_path: Path, run: Run
) -> None:
    assert run("inspect", params) == (
        1,
        "",
        f"ecu-node: {params}: nobody signed this parameter file; see 'calibrator sign'\n",
    )
    code, out, err = run("inspect", keys / "set.json")
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == "key set 1: 2 of a, b, c"
    assert out.splitlines()[-1] == "not signed: a vehicle may begin with it"
    code, out, err = run("inspect", keys / "a.pub")
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert "it is a public key, and says nothing; make a key set of it with 'calibrator keys set'" in err


def test_signatures_are_verified_with_a_key_set(
    signers: Signers, parameters: VehicleParameters, tmp_path: Path, run: Run
) -> None:
    trusted, file = tmp_path / "keys-1.json", tmp_path / "f"
    trusted.write_bytes(canonical_bytes(signers.keys()) + b"\n")
    for by, words in (
        ("a", "signed by a; 2 signers are needed"),
        ("ad", "which is not trusted here"),
        ("ab", None),
    ):
        file.write_bytes(signers.parameters(parameters, 6, by=by))
        code, out, err = run("inspect", file, "--keys", trusted)
        assert out.startswith("parameter set 300 for vehicle v1, number 6\n")
        if words is None:
            assert (code, err) == (0, "")
            assert out.splitlines()[-1] == "signed by a, b; enough, 2 of a, b, c are needed"
        else:
            assert (code, len(err.splitlines()), words in err) == (1, 1, True)
    assert run("inspect", trusted, "--keys", trusted)[0] == 1
    rotated = tmp_path / "keys-2.json"
    rotated.write_bytes(signers.key_set(signers.keys("ab", version=2)))
    assert run("inspect", file, "--keys", rotated)[1].splitlines()[-1] == "signed by a, b; enough, 2 of a, b are needed"
    code, out, err = run("inspect", file, "--keys", file)
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert f"{file}: " in err
    assert run("inspect", tmp_path, "--keys", trusted)[0] == 2
