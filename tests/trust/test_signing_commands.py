"""``calibrator sign`` and ``revoke``: what goes wrong is one line, and nothing is half signed."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from calibrator.errors import SigningError
from calibrator.signing.numbers import signing_time
from ecu_node.trust.statements import Revocation, SignedParameters, open_statement, verify
from tests.trust.signing import Run
from tests.trust.signing_steps import by, full_disk, key_set, require_one_line


def sequence_of(path: Path) -> int:
    _, statement = open_statement(path.read_bytes(), "f")
    assert isinstance(statement, SignedParameters | Revocation)
    return statement.sequence


def test_each_signer_adds_a_signature(calibrator: Run, keys: Path, params: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    sign = ["sign", params, "--sequence", 7, "--out", first]
    assert calibrator(*sign, *by(keys, "a")) == (0, f"{first}/v1.json\n", "")
    assert calibrator("sign", first / "v1.json", *by(keys, "b"), "--out", second)[0] == 0
    found = verify((second / "v1.json").read_bytes(), key_set(keys), "f")
    assert found.signers == ["a", "b"]
    assert isinstance(found.statement, SignedParameters)
    assert found.statement.sequence == 7
    assert calibrator("sign", second / "v1.json", *by(keys, "b"), "--out", tmp_path / "third")[0] == 0
    assert (tmp_path / "third" / "v1.json").read_bytes() == (second / "v1.json").read_bytes(), "who signs twice"


def test_a_file_takes_no_more_signatures_than_a_vehicle_reads(calibrator: Run, params: Path, tmp_path: Path) -> None:
    names = [f"n{number}" for number in range(17)]
    for name in names:
        assert calibrator("keys", "new", name, "--no-passphrase", "--out", tmp_path / "many")[0] == 0
    many = by(tmp_path / "many", names)
    assert calibrator("sign", params, *many[:32], "--out", tmp_path / "sixteen")[0] == 0
    done = calibrator("sign", tmp_path / "sixteen" / "v1.json", *many[32:], "--out", tmp_path / "more")
    require_one_line(done, "no vehicle could read this signed")
    assert not (tmp_path / "more").exists()


def test_a_file_that_was_changed_after_it_was_signed_is_not_signed_by_one_more(
    calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "first")[0] == 0
    path = tmp_path / "first" / "v1.json"
    for old, new in ((b'"payload":"', b'"payload":"A'), (b"}\n", b"} \n")):
        path.write_bytes(path.read_bytes().replace(old, new, 1))
        require_one_line(calibrator("sign", path, *by(keys, "b"), "--out", tmp_path / "second"), f"{path}: ")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not a parameter file"),
        (b"{}", "not a parameter file"),
        (b"\xff", "not a parameter file"),
        (b"[" * 100_000, "not a parameter file"),
        (b'{"vehicle": "v1", "vehicle": "v1"}', "not a parameter file"),
        (None, "no such parameter file"),
    ],
)
def test_what_is_no_parameter_file_is_not_signed(
    content: bytes | None, words: str, calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    path = tmp_path / "other.json"
    if content is not None:
        path.write_bytes(content)
    done = calibrator("sign", params, path, *by(keys, "a"), "--out", tmp_path / "signed")
    require_one_line(done, f"{path}: {words}")
    assert not (tmp_path / "signed").exists(), "all or none"


def test_a_number_that_the_signed_file_could_not_say_is_refused(
    calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    document = json.loads(params.read_text())
    for key, value in (("number", 1 << 60), ("junction_residual", {"measured_a": 1e20, "corrected_a": 0.1})):
        params.write_text(json.dumps({**document, key: value}))
        done = calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "signed")
        require_one_line(done, f"{params}: ")
        assert not (tmp_path / "signed").exists()


def test_two_files_of_one_name_are_not_signed_into_one(
    calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "v1.json").write_bytes(params.read_bytes())
    done = calibrator("sign", params, tmp_path / "more" / "v1.json", *by(keys, "a"), "--out", tmp_path / "signed")
    require_one_line(done, "files of one name would overwrite each other")
    assert not (tmp_path / "signed").exists()


def test_files_that_exist_are_replaced_only_if_that_is_asked_for(
    calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    sign = ["sign", params, *by(keys, "a"), "--sequence"]
    assert calibrator(*sign, 7, "--out", tmp_path / "signed")[0] == 0
    before = (tmp_path / "signed" / "v1.json").read_bytes()
    done = calibrator(*sign, 8, "--out", tmp_path / "signed")
    require_one_line(done, f"{tmp_path}/signed/v1.json: there is a file already")
    assert "--replace" in done[2]
    assert (tmp_path / "signed" / "v1.json").read_bytes() == before
    assert calibrator(*sign, 8, "--out", tmp_path / "signed", "--replace")[0] == 0
    assert (tmp_path / "signed" / "v1.json").read_bytes() != before
    require_one_line(calibrator(*sign, 8, "--out", params), f"{params} is a file")
    require_one_line(calibrator(*sign, 8, "--out", tmp_path), "there is a file already")


def test_a_later_signature_has_a_higher_number(calibrator: Run, keys: Path, params: Path, tmp_path: Path) -> None:
    for options in (["--sequence", "0"], ["--sequence", str(1 << 53)], ["--sequence", "x"], ["--days", "0"]):
        assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "s", *options)[0] == 2
    wrong = ["revoke", "--vehicle", "v1", "--number", 1 << 53, "--why", "w", *by(keys, "a"), "--out", tmp_path / "r"]
    code, _, error = calibrator(*wrong)
    assert (code, error.count("'--number'")) == (2, 1)
    now = int(datetime.now(UTC).timestamp())
    assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "hand", "--sequence", 7)[0] == 0
    assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "time")[0] == 0
    revoke = ["revoke", "--vehicle", "v1", "--number", 5, "--why", "w", *by(keys, "a")]
    assert calibrator(*revoke, "--out", tmp_path / "r")[0] == 0
    tomorrow = ["--sequence", now + 86_000]
    assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "tomorrow", *tomorrow)[0] == 0
    paths = (
        tmp_path / "hand" / "v1.json",
        tmp_path / "time" / "v1.json",
        tmp_path / "r",
        tmp_path / "tomorrow/v1.json",
    )
    numbers = [sequence_of(path) for path in paths]
    assert numbers == sorted(numbers)
    assert numbers[0] == 7
    assert now <= numbers[1] <= now + 60


def test_a_digit_too_many_in_the_number_is_refused(calibrator: Run, keys: Path, params: Path, tmp_path: Path) -> None:
    """A vehicle that took it would refuse all that is signed with the time as number."""
    now = int(datetime.now(UTC).timestamp())
    sign = ["sign", params, *by(keys, "a"), "--out", tmp_path / "s", "--sequence"]
    revoke = ["revoke", "--vehicle", "v1", "--number", 5, "--why", "w", *by(keys, "a"), "--out", tmp_path / "r"]
    revoke.append("--sequence")
    for number in (10 * now, now + 90_000, 1 << 52):
        for command in (sign, revoke):
            require_one_line(calibrator(*command, number), f"--sequence {number}: above the time in seconds, ")
    assert not (tmp_path / "s").exists()
    assert not (tmp_path / "r").exists()
    assert calibrator(*sign, 10 * now, "--far-sequence")[0] == 0
    assert calibrator(*revoke, (1 << 53) - 1, "--far-sequence")[0] == 0
    assert (sequence_of(tmp_path / "s" / "v1.json"), sequence_of(tmp_path / "r")) == (10 * now, (1 << 53) - 1)


@pytest.mark.parametrize(
    "now", ["1969-12-31T23:59:59", "1970-01-01T00:03:00", "2024-12-31T23:59:59", "9999-01-01T00:00:00"]
)
def test_a_clock_that_cannot_be_right_is_told(now: str) -> None:
    with pytest.raises(SigningError, match=f"the clock of this machine says {now}.*; set it: ") as caught:
        signing_time(datetime.fromisoformat(now).replace(tzinfo=UTC))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--vehicle", "", "--number", "5", "--why", "w"], "`$.vehicle`"),
        (["--vehicle", "v" * 65, "--number", "5", "--why", "w"], "`$.vehicle`"),
        (["--vehicle", "v1", "--number", "5", "--why", ""], "`$.why`"),
        (["--vehicle", "v1", "--number", "5", "--why", "w" * 201], "`$.why`"),
        (["--vehicle", "v1", *(f"--number={n}" for n in range(1, 70)), "--why", "w"], "`$.revokes`"),
        (["--vehicle", "v1", "--number", "5", "--why", "\udcff"], "canonical JSON"),
    ],
)
def test_a_revocation_that_no_vehicle_would_take_is_not_signed(
    options: list[str], words: str, calibrator: Run, keys: Path, tmp_path: Path
) -> None:
    require_one_line(calibrator("revoke", *options, *by(keys, "a"), "--out", tmp_path / "r"), words)
    assert not (tmp_path / "r").exists()


def test_a_signed_file_on_a_full_disk_leaves_nothing(calibrator: Run, keys: Path, params: Path, tmp_path: Path) -> None:
    out = tmp_path / "signed"
    revoke = ["revoke", "--vehicle", "v1", "--number", 5, "--why", "w", *by(keys, "a"), "--out", tmp_path / "r"]
    with full_disk(500):
        done = calibrator("sign", params, *by(keys, "a"), "--out", out)
    require_one_line(done, f"{out}/v1.json: cannot be written: File too large")
    assert not out.exists()
    with full_disk(0):
        done = calibrator(*revoke)
    require_one_line(done, f"{tmp_path}/r: cannot be written: File too large")
    assert not list(tmp_path.glob("*r*.partial*"))
    assert not (tmp_path / "r").exists()


def test_where_nothing_can_be_written_is_one_line(calibrator: Run, keys: Path, params: Path, tmp_path: Path) -> None:
    revoke = ["revoke", "--vehicle", "v1", "--number", 5, "--why", "w", *by(keys, "a"), "--out"]
    for out in (tmp_path / "none" / "r", tmp_path / ("x" * 300), params / "r"):
        require_one_line(calibrator(*revoke, out), f"{out}: ")
    for out in (tmp_path / ("x" * 300), params / "s"):
        require_one_line(calibrator("sign", params, *by(keys, "a"), "--out", out), f"{out}: ")
        require_one_line(calibrator("keys", "new", "n", "--no-passphrase", "--out", out), f"{out}: ")
