"""``calibrator keys``: what goes wrong is one line, and private keys stay private."""

import json
import os
import shutil
import subprocess
from base64 import b64decode
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)

from calibrator.signing.key_files import PASSPHRASE_VARIABLE
from ecu_node.trust.statements import verify
from tests.trust.signing import Run
from tests.trust.signing_steps import by, full_disk, key_set, require_one_line

PASSPHRASE = "correct horse battery staple"
FEWEST_ROUNDS = 600_000


def test_a_private_key_is_for_its_owner_alone_and_never_printed(calibrator: Run, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        code, out, err = calibrator("keys", "new", "a", "--no-passphrase", "--out", tmp_path)
    finally:
        os.umask(before)
    assert (code, out, err) == (0, f"{tmp_path}/a.key\n{tmp_path}/a.pub\n", "")
    assert (tmp_path / "a.key").stat().st_mode & 0o777 == 0o600
    secret = (tmp_path / "a.key").read_text().splitlines()[1]
    assert secret not in (tmp_path / "a.pub").read_text()


def test_an_encrypted_key_signs_with_its_passphrase_alone(
    calibrator: Run, params: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSPHRASE_VARIABLE, PASSPHRASE)
    assert calibrator("keys", "new", "a", "--out", tmp_path)[0] == 0
    assert "ENCRYPTED" in (tmp_path / "a.key").read_text()
    sign = ["sign", params, "--key", tmp_path / "a.key", "--out", tmp_path / "signed"]
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "another")
    require_one_line(calibrator(*sign), "a.key: a private key, but is encrypted with another passphrase than that in $")
    monkeypatch.setenv(PASSPHRASE_VARIABLE, PASSPHRASE)
    code, out, err = calibrator(*sign)
    assert (code, err) == (0, "")
    assert PASSPHRASE not in out
    monkeypatch.delenv(PASSPHRASE_VARIABLE)
    require_one_line(calibrator(*sign, "--replace"), "it is encrypted; see $")


def test_a_passphrase_for_a_key_that_is_not_encrypted_is_refused(
    calibrator: Run, keys: Path, params: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSPHRASE_VARIABLE, PASSPHRASE)
    done = calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "signed")
    require_one_line(done, "it is not encrypted, and yet a passphrase is given")


@pytest.mark.parametrize(
    ("passphrase", "options", "words", "code"),
    [
        (None, [], "give either a passphrase", 2),
        (PASSPHRASE, ["--no-passphrase"], "give either a passphrase", 2),
        ("x" * 2000, [], "longer than 1023 bytes", 1),
        ("seven77", [], "shorter than 8 characters", 1),
    ],
)
def test_a_key_needs_a_passphrase_or_the_word_that_it_has_none(
    passphrase: str | None,
    options: list[str],
    words: str,
    code: int,
    calibrator: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if passphrase is not None:
        monkeypatch.setenv(PASSPHRASE_VARIABLE, passphrase)
    require_one_line(calibrator("keys", "new", "a", "--out", tmp_path / "k", *options), words, code)
    assert list(tmp_path.iterdir()) == []


def test_a_passphrase_that_is_no_text_is_one_all_the_same(
    calibrator: Run, params: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "\udcff\udcfe" * 4)
    assert calibrator("keys", "new", "a", "--out", tmp_path)[0] == 0
    assert calibrator("sign", params, "--key", tmp_path / "a.key", "--out", tmp_path / "signed")[0] == 0


def test_a_passphrase_is_tried_with_many_rounds(
    calibrator: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The count stands in the file, as DER: PBKDF2 with HMAC-SHA256."""
    monkeypatch.setenv(PASSPHRASE_VARIABLE, PASSPHRASE)
    assert calibrator("keys", "new", "a", "--out", tmp_path)[0] == 0
    found = b64decode("".join((tmp_path / "a.key").read_text().splitlines()[1:-1]))
    place = found.index(bytes.fromhex("06092a864886f70d01050c"))
    salt = place + 11 + 2
    assert found[salt : salt + 2] == b"\x04\x10"
    assert found[salt + 18 : salt + 20] == b"\x02\x03"
    assert int.from_bytes(found[salt + 20 : salt + 23], "big") >= FEWEST_ROUNDS
    assert found[salt + 25 : salt + 35].hex() == "06082a864886f70d0209"


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl to read keys with")
def test_openssl_reads_an_encrypted_key(calibrator: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PASSPHRASE_VARIABLE, PASSPHRASE)
    assert calibrator("keys", "new", "a", "--out", tmp_path)[0] == 0
    command = ["openssl", "pkey", "-in", f"{tmp_path}/a.key", "-passin", f"env:{PASSPHRASE_VARIABLE}", "-pubout"]
    done = subprocess.run([*command, "-outform", "DER"], capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout[-32:].hex() == json.loads((tmp_path / "a.pub").read_text())["key"]["ed25519"]


def test_keys_of_other_encryptions_and_short_passphrases_can_still_be_read(
    calibrator: Run, keys: Path, params: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = load_pem_private_key((keys / "a.key").read_bytes(), None)
    text = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"short"))
    (keys / "a.key").write_bytes(text)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "short")
    assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "signed")[0] == 0


def test_a_damaged_key_is_not_one_with_another_passphrase(
    calibrator: Run, params: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSPHRASE_VARIABLE, PASSPHRASE)
    path = tmp_path / "a.key"
    assert calibrator("keys", "new", "a", "--out", tmp_path)[0] == 0
    whole = path.read_text().splitlines(keepends=True)
    for damaged in ([*whole[:-2], whole[-1]], whole[:-1], [whole[0], "*", *whole[1:]], [whole[0], whole[-1]]):
        path.write_text("".join(damaged))
        require_one_line(calibrator("sign", params, "--key", path, "--out", tmp_path / "s"), "the file is damaged")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o644])
def test_a_private_key_that_others_can_read_or_write_is_refused(
    mode: int, calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    path = keys / "a.key"
    path.chmod(mode)
    done = calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "signed")
    require_one_line(done, f"{path}: others than its owner can read or write this private key (mode {mode:03o}); ")
    assert f"'chmod 600 {path}'" in done[2]
    for mine in (0o600, 0o400, 0o700):
        path.chmod(mine)
        assert calibrator("sign", params, *by(keys, "a"), "--out", tmp_path / "signed", "--replace")[0] == 0


@pytest.mark.parametrize("name", ["", ".", "../a", "a b", "a/b", "a\n", "x" * 65, "-"])
def test_a_signers_name_is_one_that_files_can_have(name: str, calibrator: Run, tmp_path: Path) -> None:
    done = calibrator("keys", "new", "--no-passphrase", "--out", tmp_path, "--", name)
    require_one_line(done, "a name of letters, digits, '.', '_' and '-' is expected")


def test_a_key_that_exists_is_never_replaced(calibrator: Run, keys: Path) -> None:
    before = (keys / "a.key").read_bytes()
    require_one_line(calibrator("keys", "new", "a", "--no-passphrase", "--out", keys), "there is a key already")
    (keys / "a.key").rename(keys / "kept")
    require_one_line(calibrator("keys", "new", "a", "--no-passphrase", "--out", keys), "there is a key already")
    assert (keys / "kept").read_bytes() == before


def foreign(path: Path) -> None:
    """A private key of another kind."""
    key = generate_private_key(SECP256R1())
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


def public(path: Path) -> None:
    path.write_bytes(path.with_name("a.pub").read_bytes())


def torn(path: Path) -> None:
    path.write_bytes(path.with_name("a.key").read_bytes()[:60])


def huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 30)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (foreign, "a private key, but not of kind Ed25519"),
        (public, "not a private key (PEM); NAME.key of"),
        (torn, "the file is damaged"),
        (lambda path: path.write_bytes(b"\xff\x00"), "not a private key (PEM); NAME.key of"),
        (huge, "not a private key: it is larger than"),
        (Path.mkdir, "not a private key: it is a folder"),
        (os.mkfifo, "not a private key: it is a pipe"),
        (lambda path: None, "cannot read the private key: No such file"),
    ],
)
def test_what_is_no_private_key_is_refused(
    make: Callable[[Path], object], words: str, calibrator: Run, keys: Path, params: Path, tmp_path: Path
) -> None:
    before = os.umask(0o077)
    try:
        make(keys / "x.key")
    finally:
        os.umask(before)
    done = calibrator("sign", params, *by(keys, "ax"), "--out", tmp_path / "signed")
    require_one_line(done, f"{keys}/x.key: ")
    assert words in done[2]
    assert not (tmp_path / "signed").exists()


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        ("aa", ["--threshold", "2"], "one key is given twice"),
        ("ab", ["--threshold", "3"], "3 signers are needed, and 2 keys are there"),
    ],
)
def test_a_key_set_that_cannot_work_is_refused(
    names: str, options: list[str], words: str, calibrator: Run, keys: Path, tmp_path: Path
) -> None:
    files = [keys / f"{name}.pub" for name in names]
    require_one_line(calibrator("keys", "set", *files, *options, "--out", tmp_path / "s"), words)
    assert not (tmp_path / "s").exists()


def test_a_key_set_is_made_of_public_keys_alone(calibrator: Run, keys: Path, tmp_path: Path) -> None:
    (keys / "cut.pub").write_bytes((keys / "a.pub").read_bytes()[:50])
    for name in ("a.key", "cut.pub", "set.json"):
        done = calibrator("keys", "set", keys / name, "--threshold", 1, "--out", tmp_path / "s")
        require_one_line(done, f"{keys / name}: not a public key")


def test_only_a_later_key_set_is_signed(calibrator: Run, keys: Path, tmp_path: Path) -> None:
    make = ["keys", "set", keys / "a.pub", "--threshold", 1, "--out", tmp_path / "s"]
    require_one_line(calibrator(*make, *by(keys, "a")), "the first key set is not signed", 2)
    require_one_line(calibrator(*make, "--version", 2), "every later one is", 2)
    assert calibrator(*make, "--version", 2, *by(keys, "ab"))[0] == 0
    assert verify((tmp_path / "s").read_bytes(), key_set(keys), "f").signers == ["a", "b"]
    require_one_line(calibrator(*make, "--version", 2, *by(keys, "ab")), "there is a file already")


def test_a_key_set_that_no_vehicle_could_read_is_not_made(calibrator: Run, tmp_path: Path) -> None:
    folder, out = tmp_path / "many", tmp_path / "s"
    for number in range(17):
        assert calibrator("keys", "new", f"n{number}", "--no-passphrase", "--out", folder)[0] == 0
    public = sorted(folder.glob("*.pub"))
    words = "not a key set that a vehicle would take: "
    require_one_line(calibrator("keys", "set", *public, "--threshold", 2, "--out", out), words)
    make = ["keys", "set", *public[:3], "--threshold", 2, "--out", out]
    for version in (1_000_001, 9_007_199_254_740_993):
        code, _, error = calibrator(*make, "--version", version, *by(folder, ["n0"]))
        assert (code, error.count("--version"), error.count("1000000")) == (2, 1, 1)
    assert not out.exists()
    assert calibrator(*make)[0] == 0
    assert calibrator(*make[:-1], tmp_path / "last", "--version", 1_000_000, *by(folder, ["n0", "n1"]))[0] == 0


def test_one_name_for_two_keys_is_refused(calibrator: Run, tmp_path: Path) -> None:
    for folder in ("one", "other"):
        assert calibrator("keys", "new", "a", "--no-passphrase", "--out", tmp_path / folder)[0] == 0
    public = [tmp_path / "one" / "a.pub", tmp_path / "other" / "a.pub"]
    done = calibrator("keys", "set", *public, "--threshold", 2, "--out", tmp_path / "s")
    require_one_line(done, "a stands there with two keys")


@pytest.mark.parametrize("free_bytes", [0, 60, 150])
def test_a_key_on_a_full_disk_leaves_nothing(free_bytes: int, calibrator: Run, tmp_path: Path) -> None:
    """The private key has 119 bytes, the public one more."""
    with full_disk(free_bytes):
        done = calibrator("keys", "new", "a", "--no-passphrase", "--out", tmp_path)
    require_one_line(done, f"{tmp_path}: no key can be written there: File too large")
    assert list(tmp_path.iterdir()) == []
