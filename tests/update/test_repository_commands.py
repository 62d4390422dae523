"""``calibrator repository``: keys, thresholds, signers one after the other, and mistakes in one line."""

import os
import re
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from tuf.api.metadata import Root

from calibrator.files.storage import open_storage
from ecu_node.parameters import VehicleParameters, write_parameters
from ecu_node.update.signers import PASSPHRASE_VARIABLE, public_key_of
from tests.disk import full_disk
from tests.ecu_node.processes import wait_until
from tests.ecu_node.vehicles import LAYOUT
from tests.update.repo import ALL, Repo, drifting, expired


def failed(repo: Repo, words: str, *command: object, code: int = 1) -> None:
    found, out, err = repo.calibrator("repository", *command)
    assert (found, out, err.count("\n")) == (code, "", 1), (out, err)
    assert err.startswith("calibrator: ")
    assert words in err


def public_key(repo: Repo, name: str) -> Path:
    return repo.folder / "keys" / f"{name}.pub"


def keyid(repo: Repo, name: str) -> str:
    return public_key_of(public_key(repo, name)).keyid[:8]


def keys(repo: Repo, *names: str) -> list[object]:
    return [word for name in names for word in ("--key", repo.key(name))]


def test_several_signers_can_sign_one_after_another(repo: Repo, new: Path, other: VehicleParameters) -> None:
    repo.updated(new)
    repo.add(other)
    lacking = f"not published: {repo.bin} has 1 of 2 signatures, not of {keyid(repo, 't2')}; snapshot has 0 of 1"
    failed(repo, lacking, "publish", repo.path, *keys(repo, "t1"))
    assert repo.updated(new).startswith("nothing new: "), "vehicles see nothing of it yet"
    lacking = "; ".join(
        f"{role} has 0 of 1 signatures, not of {keyid(repo, role)}" for role in ("snapshot", "timestamp")
    )
    failed(repo, f"not published: {lacking}; publish again", "publish", repo.path, *keys(repo, "t2"))
    assert f"; 1 role staged: {lacking}\n" in repo.done("status", repo.path)
    repo.publish("snapshot", "timestamp")
    assert repo.updated(new).startswith("on trial: parameter set 301")


def test_change_after_a_signature_invalidates_all_signatures(repo: Repo, other: VehicleParameters) -> None:
    repo.add(other)
    failed(repo, "has 1 of 2 signatures", "publish", repo.path, *keys(repo, "t1"))
    repo.done("revoke", repo.path, "v1")
    out = repo.done("publish", repo.path, *keys(repo, "t2", "snapshot", "timestamp"))
    assert f"what is staged is not published: {repo.bin} has 1 of 2 signatures" in out


def test_staged_unsigned_roles_do_not_block_a_new_timestamp(repo: Repo, state: Path, other: VehicleParameters) -> None:
    """Otherwise a signer who is away for 30 days would stop the updates of the whole fleet."""
    repo.updated(state)
    repo.add(other)
    repo.add(other, vehicle="v3")
    repo.add(other, vehicle="v4")
    repo.done("rotate", repo.path, "timestamp", "--public", public_key(repo, "new"))
    assert "the timestamp is new" in repo.done("publish", repo.path, *keys(repo, "snapshot", "timestamp"))
    assert repo.updated(state).startswith("nothing new: ")
    assert "timestamp 2, snapshot 2" in repo.node("inspect", "--state", state)[1]
    assert "; and 2 more roles\n" in repo.done("status", repo.path)
    assert "4 staged roles dropped" in repo.done("unstage", repo.path)
    assert "; 0 roles staged" in repo.done("status", repo.path)
    repo.publish()
    assert repo.updated(state).startswith("nothing new: ")
    assert "root 1, timestamp 3" in repo.node("inspect", "--state", state)[1]


def test_key_rotation_keeps_the_threshold_unless_another_is_given(repo: Repo) -> None:
    public = [word for name in ("t1", "t2", "new") for word in ("--public", public_key(repo, name))]
    assert "targets 2 of 3; " in repo.done("rotate", repo.path, "targets", *public)
    failed(repo, "targets: 2 signatures of 1 keys", "rotate", repo.path, "targets", *public[:2], code=2)
    failed(repo, "the same key is given twice", "rotate", repo.path, "targets", *public[:2], *public[:2], code=2)
    assert "1 of 1 (was 2)" in repo.done("rotate", repo.path, "targets", *public[:2], "--threshold", 1)


def test_adding_a_revoked_file_again_ends_its_revocation_and_says_so(repo: Repo, state: Path) -> None:
    repo.done("revoke", repo.path, "v1")
    repo.publish()
    repo.updated(state)
    (path,) = (repo.path / "targets").glob("*.v1.json")
    assert "; revoked before, and no longer: the files of v1; to be" in repo.done("add", repo.path, path)
    repo.publish()
    assert repo.updated(state).startswith("on trial: ")


def test_interrupted_publication_can_be_completed(
    repo: Repo, new: Path, other: VehicleParameters, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a full disk or an internal error; until the new timestamp vehicles receive the previous files."""
    repo.updated(new)
    repo.add(other)
    publish = ("publish", repo.path, *keys(repo, *ALL))
    with full_disk(300):
        failed(repo, "File too large", *publish)
    assert repo.updated(new).startswith("nothing new: ")
    with monkeypatch.context() as patch:
        patch.setattr("calibrator.repository.repository.os.sync", lambda: 1 / 0)
        failed(repo, "internal error", *publish, code=70)
    assert repo.updated(new).startswith("nothing new: ")
    repo.publish()
    assert repo.updated(new).startswith("on trial: parameter set 301")


def test_key_given_by_uri_signs_like_a_key_file(repo: Repo, new: Path, other: VehicleParameters) -> None:
    """The same way leads to security modules and cloud services."""
    repo.add(other)
    private = generate_private_key(SECP256R1())
    (repo.folder / "ec.pem").write_bytes(private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public = private.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    (repo.folder / "ec.pub").write_bytes(public)
    repo.done("rotate", repo.path, "timestamp", "--public", repo.folder / "ec.pub")
    uri = f"{repo.folder / 'ec.pub'}=file2:{repo.folder / 'ec.pem'}"
    repo.done("publish", repo.path, *keys(repo, *ALL), "--key", uri)
    assert repo.updated(new).startswith("on trial: parameter set 301")


def test_unusable_key_is_refused_in_one_line(repo: Repo) -> None:
    """Such as a public key, a missing file, an unknown kind of URI, or a key that others may read."""
    public, none = public_key(repo, "t1"), repo.folder / "none"
    repo.key("t1").chmod(0o644)
    for key, words in (
        (public, "cannot be used as a private key"),
        (f"{public}=file2:{none}", "the key cannot be used"),
        (f"{public}=pigeon:1", "the key cannot be used"),
        (f"{none}=file2:x", "cannot read the public key"),
        (repo.key("t1"), "others than its owner can read"),
    ):
        failed(repo, words, "publish", repo.path, "--key", key)


def test_encrypted_key_needs_its_own_passphrase(repo: Repo, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "short")
    failed(repo, "at least 12 characters", "key", "dora", "--out", tmp_path, code=2)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "a long passphrase")
    repo.done("key", "dora", "--out", tmp_path)
    private = tmp_path / "dora.key"
    assert private.stat().st_mode & 0o777 == 0o600
    read = ["openssl", "pkey", "-in", str(private), "-passin", "pass:a long passphrase", "-pubout"]
    assert subprocess.run(read, capture_output=True, check=True).stdout == (tmp_path / "dora.pub").read_bytes()
    failed(repo, "belongs to no role here", "publish", repo.path, "--key", private)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "another passphrase")
    failed(repo, "it is encrypted, and the passphrase", "publish", repo.path, "--key", private)
    monkeypatch.delenv(PASSPHRASE_VARIABLE)
    failed(repo, "give its passphrase in", "publish", repo.path, "--key", private)
    failed(repo, "give either a passphrase", "key", "e", "--out", tmp_path, code=2)


def test_passphrase_is_asked_for_in_a_terminal(repo: Repo, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with monkeypatch.context() as patch:
        patch.setenv(PASSPHRASE_VARIABLE, "a long passphrase")
        repo.done("key", "dora", "--out", tmp_path)
    terminal, program_end = os.openpty()
    key = str(tmp_path / "dora.key")
    command = [sys.executable, "-m", "calibrator", "repository", "publish", str(repo.path), "--key", key]
    with subprocess.Popen(command, stdin=program_end, stderr=subprocess.PIPE, start_new_session=True) as program:
        assert program.stderr is not None
        prompt = f"passphrase of {key}: ".encode()
        shown = program.stderr.read(len(prompt))
        os.write(terminal, b"a long passphrase\n")
        assert shown == prompt
        assert b"belongs to no role here" in program.stderr.read()
    os.close(terminal)
    os.close(program_end)


@pytest.mark.parametrize("kind", ["key", "pub"])
def test_existing_key_is_never_overwritten(kind: str, repo: Repo) -> None:
    path = repo.folder / f"anna.{kind}"
    path.write_text("of somebody else")
    failed(repo, f"{path}: there is a key already", "key", "anna", "--no-passphrase", "--out", repo.folder)
    assert [item.read_text() for item in repo.folder.glob("anna.*")] == ["of somebody else"]


@pytest.mark.parametrize("free_bytes", [0, 115])
def test_partly_written_key_is_removed(free_bytes: int, repo: Repo) -> None:
    with full_disk(free_bytes):
        failed(repo, "cannot be written: File too large", "key", "anna", "--no-passphrase", "--out", repo.folder)
    assert not list(repo.folder.glob("*anna*"))


def test_mistakes_are_refused_and_change_nothing(repo: Repo, other: VehicleParameters, tmp_path: Path) -> None:
    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in repo.path.rglob("*") if path.is_file()}

    repo.add(other)
    before, public, good = files(), public_key(repo, "t1"), repo.folder / "v1.json"
    (tmp_path / "bad.json").write_text("{}")
    write_parameters(drifting(other, 0.9), tmp_path / "wild.json")
    roles = [word for role in ("--root", "--targets", "--snapshot", "--timestamp") for word in (role, public)]
    failed(repo, "exists and is not empty", "init", repo.path, *roles)
    failed(repo, "3 signatures of 1 keys", "init", tmp_path / "x", *roles, "--root-threshold", 3, code=2)
    failed(repo, "no public key", "rotate", repo.path, "root", "--public", tmp_path / "bad.json")
    failed(repo, "bad.json: ", "add", repo.path, good, tmp_path / "bad.json")
    failed(repo, "no vehicle will take it: branch", "add", repo.path, tmp_path / "wild.json", "--layout", LAYOUT)
    failed(repo, "a second file for vehicle v1", "add", repo.path, good, good)
    failed(repo, "no parameters of vehicle 'v9' here", "revoke", repo.path, "v1", "v9")
    failed(repo, "no parameters of vehicle", "revoke", repo.path, b"\xff")
    failed(repo, "vehicle 'v1' never had a file 00000000...", "revoke", repo.path, "v1", "--sha256", 64 * "0")
    failed(repo, "v1 is named twice", "revoke", repo.path, "v1", "v1", code=2)
    failed(repo, "64 digits", "revoke", repo.path, "v1", "--sha256", "12", code=2)
    failed(repo, "no parameters of vehicle 'v9' are published here", "bundle", repo.path, "v9", "--out", tmp_path / "b")
    assert files() == before


def test_status_gives_the_expiry_of_a_root_that_expires_before_the_timestamp_role(repo: Repo) -> None:
    def expire_soon(root: Root) -> None:
        root.expires = datetime.now(UTC).replace(microsecond=0) + timedelta(days=3)

    repo.forge("root", expire_soon, "r1", "r2")
    repo.publish("snapshot", "timestamp")
    day = f"{datetime.now(UTC) + timedelta(days=3):%Y-%m-%d}"
    assert f"valid until {day}; 1 role staged: root has 0 of 2 signatures" in repo.done("status", repo.path)


def test_damaged_or_expired_repository_is_refused_in_one_line(repo: Repo) -> None:
    bundle, publish = ("bundle", repo.path, "v1", "--out", repo.folder / "b"), ("publish", repo.path, *keys(repo, *ALL))
    repo.forge("timestamp", expired, "timestamp")
    failed(repo, "when its metadata expired; publish first", *bundle)
    repo.publish()
    (repo.metadata / "copy of 1.root.json").write_text("")
    assert "valid until" in repo.done("status", repo.path)
    next((repo.path / "targets").glob("*.v1.json")).write_bytes(b"\xff")
    failed(repo, "'v1' are damaged; take a copy", *bundle)
    repo.live(repo.bin).write_bytes(b"\xff")
    failed(repo, "cannot be read as metadata", *publish)
    repo.live("targets").write_bytes(repo.live("timestamp").read_bytes())
    failed(repo, "cannot be read as metadata: it is of another role; take a copy", "status", repo.path)
    repo.live("targets").write_bytes(b"\xff")
    failed(repo, "cannot be read as metadata", "status", repo.path)


def test_command_waits_while_another_one_writes_the_repository(repo: Repo) -> None:
    command = [sys.executable, "-m", "calibrator", "repository", "unstage", str(repo.path)]
    with open_storage(repo.path).locked():
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        waiting = re.compile(rf"-> \w+ .* {process.pid} ")
        wait_until(lambda: waiting.search(Path("/proc/locks").read_text()) is not None)
    assert "0 staged roles dropped" in process.communicate(timeout=60)[0]
