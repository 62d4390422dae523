"""Where a vehicle keeps its state: made once, of a key set, in a folder; and what files and links must not do there."""

import os
import subprocess
import sys
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.cli import main
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.canonical import canonical_bytes
from tests.trust.signing import Run, Signers, on

HOUR = timedelta(hours=1)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not a key set"),
        (b"{}", "not a key set: Object missing required field `version`; make one with 'calibrator keys set'"),
        (b'{"keys":{},"schema_version":1,"threshold":1,"version":1}', "not a key set"),
        (bytes(3000), "not a key set"),
        (None, "it is larger than"),
    ],
)
def test_a_vehicle_is_not_provisioned_with_what_is_no_key_set(
    content: bytes | None, words: str, tmp_path: Path, run: Run
) -> None:
    path = tmp_path / "keys.json"
    path.write_bytes(content or b"")
    if content is None:
        os.truncate(path, 1 << 30)
    code, out, err = run("provision", "--vehicle", "v1", "--keys", path, "--state", tmp_path / "state")
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert words in err
    assert not (tmp_path / "state").exists()


def test_a_vehicle_is_provisioned_once_and_only_in_a_folder(tmp_path: Path, signers: Signers, run: Run) -> None:
    (tmp_path / "keys.json").write_bytes(canonical_bytes(signers.keys()) + b"\n")
    options = ["provision", "--vehicle", "v1", "--keys", tmp_path / "keys.json", "--state"]
    assert run(*options, tmp_path / "state")[:2] == (0, f"{tmp_path}/state: vehicle v1 trusts 2 of a, b, c\n")
    for place, words in (
        (tmp_path / "state", "there is a state already"),
        (tmp_path / "keys.json", "cannot be made: File exists"),
        (tmp_path / ("x" * 300), "cannot be made: File name too long"),
    ):
        code, out, err = run(*options, place)
        assert (code, out, len(err.splitlines())) == (1, "", 1)
        assert words in err


@pytest.mark.parametrize("name", ["x" * 300, "none", "file"])
@pytest.mark.parametrize("what", ["activate", "verify"])
def test_where_no_state_can_be_is_one_line(
    name: str, what: str, signers: Signers, parameters: VehicleParameters, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "p").write_bytes(signers.parameters(parameters, 6))
    code, out, err = run(what, tmp_path / "p", *on(tmp_path / name))
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert str(tmp_path / name) in err


def test_inspecting_shows_names_from_files_without_control_characters(
    signers: Signers, parameters: VehicleParameters, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "p").write_bytes(signers.parameters(replace(parameters, vehicle="v\n\x1b[2Jall is well"), 6))
    code, out, err = run("inspect", tmp_path / "p")
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == "parameter set 300 for vehicle v\\n\\x1b[2Jall is well, number 6"


def test_inspecting_shows_all_that_a_second_signer_vouches_for(
    signers: Signers, parameters: VehicleParameters, state: Path, tmp_path: Path, run: Run
) -> None:
    """Names alone do not tell whose key is in a set."""

    def shown(content: bytes) -> str:
        (tmp_path / "f").write_bytes(content)
        code, out, _ = run("inspect", tmp_path / "f")
        assert code == 0
        return out

    found = shown(signers.key_set(signers.keys("abd", version=2)))
    assert all(signers.public[name].key.ed25519 in found for name in "abd")
    assert signers.public["a"].key.ed25519 in run("inspect", state)[1]
    assert "branch battery: drift +0.05, offset" in shown(signers.parameters(parameters, 6))
    assert "made at 2026-06-01T12:00:00Z" in shown(signers.revocation(9, 5))


def test_a_vehicle_whose_name_no_state_could_hold_is_not_provisioned(
    signers: Signers, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "keys.json").write_bytes(canonical_bytes(signers.keys()) + b"\n")
    for name in ("", "   ", " " * 70 + "v", "v" * 65):
        with pytest.raises(SystemExit) as caught:
            main(["provision", "--vehicle", name, "--keys", f"{tmp_path}/keys.json", "--state", f"{tmp_path}/state"])
        assert caught.value.code == 2
        assert "at most 64 characters" in capsys.readouterr().err
        assert not (tmp_path / "state").exists()


def test_a_folder_whose_name_is_no_text_is_provisioned(signers: Signers, tmp_path: Path) -> None:
    (tmp_path / "keys.json").write_bytes(canonical_bytes(signers.keys()) + b"\n")
    command = [sys.executable, "-m", "ecu_node", "provision", "--vehicle", "v1", "--keys", f"{tmp_path}/keys.json"]
    done = subprocess.run(
        [*command, "--state", f"{tmp_path}/s\udcff"], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "s\\udcff: vehicle v1 trusts 2 of a, b, c" in done.stdout


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
@pytest.mark.parametrize("name", ["audit.log", "lock"])
def test_another_name_of_a_file_of_roots_is_not_given_away(
    name: str, in_force: Path, signers: Signers, parameters: VehicleParameters, tmp_path: Path, now: datetime, run: Run
) -> None:
    """Where the kernel lets users make hard links to files of others."""
    secret, node = tmp_path / "secret", 1234
    secret.write_text("secret")
    (in_force / name).unlink(missing_ok=True)
    os.link(secret, in_force / name)
    os.chown(in_force, node, node)
    (tmp_path / "p").write_bytes(signers.parameters(parameters, 6, not_before=now - HOUR))
    code, out, err = run("activate", tmp_path / "p", *on(in_force))
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert "another name of somebody else's file" in err
    assert (secret.stat().st_uid, secret.read_text()) == (0, "secret")
    (in_force / name).unlink()
    assert run("activate", tmp_path / "p", *on(in_force))[0] in (0, 1)
    assert (in_force / name).stat().st_uid == node


@pytest.mark.parametrize("name", ["slot-a.json.next", ".state.json.new", "audit.log", "lock"])
def test_a_link_in_the_state_does_not_lead_to_another_file(
    name: str, in_force: Path, signers: Signers, parameters: VehicleParameters, tmp_path: Path, now: datetime, run: Run
) -> None:
    """Root activates in a folder that belongs to the node."""
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (in_force / name).unlink(missing_ok=True)
    (in_force / name).symlink_to(secret)
    (tmp_path / "p").write_bytes(signers.parameters(parameters, 6, not_before=now - HOUR))
    code, _, err = run("activate", tmp_path / "p", *on(in_force))
    assert secret.read_text() == "secret"
    assert (code, len(err.splitlines())) in ((0, 0), (1, 1))
