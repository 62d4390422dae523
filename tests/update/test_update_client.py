"""What a vehicle makes of an honest repository: our own checks, revocation, time, and files of version 1.0."""

import math
import os
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
import tuf.api.serialization.json as tuf_json
from msgspec.structs import replace
from securesystemslib.dsse import Envelope
from securesystemslib.exceptions import FormatError
from securesystemslib.formats import encode_canonical
from tuf.api.metadata import Metadata, Targets

from ecu_node.core.status import TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import FileReference, VehicleParameters
from ecu_node.update.client import update
from ecu_node.update.signers import public_key_of
from ecu_node.update.sources import open_source
from ecu_node.update.state import VehicleState, add_decision, read_state
from ecu_node.update.store import conclude, end_expired
from tests.update.damage import a_folder, a_pipe, cut, huge, without, zeros
from tests.update.repo import Repo, pass_trial

DIGEST = "0" * 64


def numbers(state: Path) -> tuple[int | None, int | None]:
    """Parameter sets in force and on trial."""
    found = read_state(state)
    return tuple(item.parameters.number if item else None for item in (found.in_force, found.on_trial))  # type: ignore[return-value]


def test_set_is_on_trial_then_in_force_and_the_one_before_is_kept(
    repo: Repo, new: Path, other: VehicleParameters
) -> None:
    repo.updated(new)
    assert numbers(new) == (None, 300)
    pass_trial(new)
    repo.offer(other)
    repo.updated(new)
    assert numbers(new) == (300, 301)
    assert "301 (" in repo.updated(new), "again: nothing new"
    pass_trial(new)
    before = read_state(new).before
    assert numbers(new) == (301, None)
    assert before is not None
    assert before.parameters.number == 300


def test_failed_set_is_gone_and_not_tried_again(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.offer(other)
    repo.updated(state)
    pass_trial(state, passed=False)
    assert numbers(state) == (300, None)
    code, _, err = repo.update(state)
    assert code == 1
    assert "has failed its trial here" in err
    repo.offer(other, "--days", 100)  # published anew
    assert repo.updated(state).startswith("on trial: ")


def test_end_of_a_trial_that_another_set_has_replaced_changes_nothing(
    repo: Repo, state: Path, other: VehicleParameters
) -> None:
    repo.offer(other)
    repo.updated(state)
    tried = read_state(state).on_trial
    repo.offer(replace(other, number=302))
    repo.updated(state)
    assert tried is not None
    conclude(state, tried, passed=True, text="seen", now=datetime.now(UTC))
    assert numbers(state) == (300, 302)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: replace(p, layout=FileReference(name="l", sha256=DIGEST)), "layout"),
        (lambda p: replace(p, dbc=FileReference(name="d", sha256=DIGEST)), "DBC"),
        (lambda p: drifting(p, 0.5), "drift"),
        (lambda p: drifting(p, 0.05 - 0.22), "differs from the set in force"),
    ],
)
def test_set_that_does_not_fit_is_refused(
    change: Callable[[VehicleParameters], VehicleParameters],
    words: str,
    repo: Repo,
    state: Path,
    parameters: VehicleParameters,
) -> None:
    repo.offer(change(parameters))
    code, out, err = repo.update(state)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert words in err
    assert str(repo.path) in err
    assert numbers(state) == (300, None)
    assert words in (state / "decisions.log").read_text().splitlines()[-1]


def drifting(parameters: VehicleParameters, drift: float) -> VehicleParameters:
    battery = replace(parameters.branches["battery"], drift=drift)
    return replace(parameters, branches={**parameters.branches, "battery": battery})


def test_large_step_needs_the_signers_word(repo: Repo, state: Path, parameters: VehicleParameters) -> None:
    repo.offer(drifting(parameters, -0.17), "--allow-large-step")
    assert repo.updated(state).startswith("on trial: ")


def test_revoked_set_gives_way_to_the_one_before(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.offer(other)
    repo.updated(state)
    pass_trial(state)
    repo.done("revoke", repo.path, "v1")
    repo.publish()
    assert "parameter set 300 (" in repo.updated(state)
    assert numbers(state) == (300, None)
    assert repo.updated(state).startswith("nothing new: ")


def test_revoked_set_in_force_gives_way_and_a_new_one_goes_on_trial(
    repo: Repo, state: Path, other: VehicleParameters
) -> None:
    found = read_state(state).in_force
    assert found is not None
    repo.add(other)
    repo.done("revoke", repo.path, "v1", "--sha256", found.sha256)
    repo.publish()
    text = repo.updated(state)
    assert "nothing is in force now" in text
    assert "on trial: parameter set 301" in text
    assert numbers(state) == (None, 301)


def test_revocation_holds_although_the_new_set_is_refused(
    repo: Repo, state: Path, parameters: VehicleParameters
) -> None:
    found = read_state(state).in_force
    assert found is not None
    repo.add(drifting(parameters, 0.5))
    repo.done("revoke", repo.path, "v1", "--sha256", found.sha256)
    repo.publish()
    code, _, err = repo.update(state)
    assert code == 1
    assert err.count("\n") == 1
    assert "nothing is in force now" in err
    assert numbers(state) == (None, None)


def test_many_revocations_push_none_out(repo: Repo, state: Path) -> None:
    """Version 1.0 forgot the first of 65."""
    repo.done("revoke", repo.path, "v1")
    for number in range(100):
        (repo.path / "targets" / f"{number:064x}.v1.json").touch()
        repo.done("revoke", repo.path, "v1", "--sha256", f"{number:064x}")
    repo.publish()
    assert "nothing is in force now" in repo.updated(state)


def test_former_set_that_is_published_again_ends_the_trial_of_its_successor(
    repo: Repo, state: Path, parameters: VehicleParameters, other: VehicleParameters
) -> None:
    repo.offer(other)
    repo.updated(state)
    repo.offer(parameters)
    repo.updated(state)
    assert numbers(state)[0] == 300
    assert numbers(state)[1] != 301


def test_same_file_with_a_later_expiry_needs_no_trial(repo: Repo, state: Path, parameters: VehicleParameters) -> None:
    repo.offer(parameters, "--days", 800)
    assert repo.updated(state).startswith("extended: parameter set 300")
    assert numbers(state) == (300, None)
    found = read_state(state).in_force
    assert found is not None
    assert found.expires > datetime.now(UTC) + timedelta(days=799)


def test_set_on_trial_that_has_expired_is_refused(
    repo: Repo, new: Path, database: VehicleDatabase, other: VehicleParameters
) -> None:
    repo.offer(other, "--days", 1)
    repo.updated(new)
    with pytest.raises(TrustError, match="expired at"):
        update(new, str(repo.path), database, datetime.now(UTC) + timedelta(days=2))


def test_dry_run_says_the_same_and_writes_nothing(repo: Repo, new: Path) -> None:
    before = {path.name: path.read_bytes() for path in new.iterdir()}
    code, out, _ = repo.update(new, None, "--dry-run")
    assert code == 0
    assert out.startswith("dry run, nothing is changed: on trial: parameter set 300")
    assert {path.name: path.read_bytes() for path in new.iterdir()} == before


def test_set_expires_for_good_and_a_clock_behind_is_not_believed(
    repo: Repo, state: Path, database: VehicleDatabase, other: VehicleParameters
) -> None:
    now = datetime.now(UTC)
    repo.offer(other, "--days", 1)
    update(state, str(repo.path), database, now)
    tried = read_state(state).on_trial
    assert tried is not None
    conclude(state, tried, passed=True, text="seen", now=now + timedelta(days=2))
    assert numbers(state) == (300, None), "it expired before its trial ended"
    assert read_state(state).latest < now + timedelta(days=1), "a clock that jumped ahead is not kept"
    with pytest.raises(TrustError, match="expired at"):
        update(state, str(repo.path), database, now + timedelta(days=40))  # the timestamp has expired by then
    found = read_state(state).in_force
    assert found is not None
    end_expired(state, found, found.expires)
    assert numbers(state) == (None, None)
    assert read_state(state).ended == "expired"


def test_time_of_an_update_is_kept(
    repo: Repo, state: Path, database: VehicleDatabase, other: VehicleParameters
) -> None:
    now = datetime.now(UTC)
    repo.offer(other, "--days", 1)
    with pytest.raises(TrustError, match="expired at"):
        update(state, str(repo.path), database, now + timedelta(days=2))
    with pytest.raises(TrustError, match="the latest time seen here is"):
        update(state, str(repo.path), database, now)


def test_canonical_json_is_that_of_securesystemslib(offered: Repo) -> None:
    """What is signed is written quickly here; keys, numbers, escapes and odd letters come out the same."""
    documents = [Metadata.from_file(str(path)).signed.to_dict() for path in offered.metadata.glob("*.json")]
    odd = {
        "b": [],
        "a": {},
        "é": "\x7f€\U0001f697/<&'",
        "": [True, False, 0, -1, 2**63],
        "A": [[{"z": "", "y": 1}]],
    }
    for document in (*documents, odd, {**odd, "n": None}, {**odd, "c": 'a "b"\\\n\x00'}):
        assert tuf_json.encode_canonical(document) == encode_canonical(document)
    with pytest.raises(FormatError):
        tuf_json.encode_canonical({"length": math.nan})


OLD = {
    "signed.json": b'{"payload":"e30=","payloadType":"x","signatures":[]}',
    "keys-1.json": b'{"keys":{},"schema_version":1,"threshold":1,"version":1}\n',
}


@pytest.mark.parametrize("name", OLD)
def test_files_of_version_1_0_are_refused_with_the_way_on(name: str, repo: Repo, state: Path) -> None:
    path = repo.folder / name
    path.write_bytes(OLD[name])
    repo.refused(state, "signed by version 1.0; publish its parameters with 'calibrator repository add'", path)
    code, _, err = repo.node("provision", "--vehicle", "v", "--root", path, "--state", repo.folder / "s")
    assert code == 1
    assert "1.root.json of 'calibrator repository init' is expected" in err
    assert not (repo.folder / "s").exists()


def test_state_of_version_1_0_is_refused_with_the_way_on(repo: Repo, state: Path) -> None:
    (state / "state.json").write_bytes(b'{"sha256":"00","state":{}}')
    code, _, err = repo.update(state)
    assert code == 1
    assert "state of version 1.0, which trusts no TUF root; remove the folder" in err


def test_vehicle_is_provisioned_once_with_a_root_that_is_signed(repo: Repo, tmp_path: Path) -> None:
    place = tmp_path / "fresh"
    for content in (b"", b"{}", b"\xff", repo.live("targets").read_bytes()):
        (tmp_path / "root.json").write_bytes(content)
        code, out, err = repo.node("provision", "--vehicle", "v", "--root", tmp_path / "root.json", "--state", place)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert not place.exists()
    repo.forge("root", lambda _: None, "r1", "mallory", bump=False)
    code, _, err = repo.node("provision", "--vehicle", "v", "--root", repo.live("root"), "--state", place)
    assert "is expected" in err
    assert not place.exists()
    code, _, err = repo.node("provision", "--vehicle", "v", "--root", tmp_path / "none", "--state", place)
    assert (code, "cannot read the root: No such file" in err) == (1, True)
    os.mkfifo(tmp_path / "pipe")
    code, _, err = repo.node("provision", "--vehicle", "v", "--root", tmp_path / "pipe", "--state", place)
    assert (code, "cannot read the root: it is a pipe" in err) == (1, True)


def test_expiry_without_time_zone_is_refused(repo: Repo, new: Path) -> None:
    def set_expiry(targets: Targets) -> None:
        targets.targets["v1.json"].custom["expires"] = "2100-01-01T00:00:00"

    repo.forge(repo.bin, set_expiry, "t1", "t2")
    repo.relist(repo.bin, "snapshot", "timestamp")
    repo.refused(new, "custom fields of v1.json: Expected `datetime` with a timezone component")


def test_what_is_refused_with_a_revocation_is_logged_with_its_own_reason(
    repo: Repo, state: Path, other: VehicleParameters
) -> None:
    repo.done("revoke", repo.path, "v1")
    repo.offer(replace(other, layout=replace(other.layout, sha256="0" * 64)))
    assert repo.update(state)[0] == 1
    lines = [msgspec.json.decode(line) for line in (state / "decisions.log").read_text().splitlines()[-2:]]
    assert [(line["event"], line.get("reason")) for line in lines] == [("revoked", None), ("refused", "WrongLayout")]


def test_second_provisioning_is_refused(offered: Repo, state: Path) -> None:
    code, _, err = offered.node(
        "provision", "--vehicle", "v1", "--root", offered.metadata / "1.root.json", "--state", state
    )
    assert code == 1
    assert "there is a state already; a new root comes with 'ecu-node update'" in err


@pytest.mark.parametrize("damage", [without, cut, zeros, a_folder, a_pipe, huge])
def test_damaged_state_is_one_line(damage: Callable[[Path], None], repo: Repo, state: Path) -> None:
    damage(state / "state.json")
    for code, out, err in (repo.update(state), repo.node("inspect", "--state", state)):
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert "provision" in err


def test_no_bit_of_the_state_can_be_another_one(state: Path) -> None:
    content = (state / "state.json").read_bytes()
    for place in range(0, len(content), 7):
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        (state / "state.json").write_bytes(damaged)
        with pytest.raises(TrustError, match="damaged"):
            read_state(state)


@pytest.mark.parametrize("damage", [without, cut, zeros, a_folder, a_pipe, huge])
def test_damaged_bundle_is_one_line(damage: Callable[[Path], None], repo: Repo, state: Path) -> None:
    bundle = repo.bundle()
    damage(bundle)
    code, out, err = repo.update(state, bundle)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert str(bundle) in err


def test_every_byte_of_a_bundle_counts(repo: Repo, new: Path) -> None:
    content = repo.bundle().read_bytes()
    changed = [
        content[:place] + bytes([content[place] ^ 1 << place % 8]) + content[place + 1 :]
        for place in range(len(content))
    ]
    cuts = [content[:length] for length in range(len(content))] + [content + b"\0", content + content]
    path = repo.folder / "changed"
    for item in (*changed, *cuts):
        path.write_bytes(item)
        with pytest.raises(TrustError, match="not a whole bundle") as caught:
            open_source(str(path))
        assert str(caught.value).isprintable()
    repo.refused(new, "not a whole bundle", path)


def test_names_break_no_line(repo: Repo, state: Path) -> None:
    path = repo.folder / "a\nb\x1b[2J"
    for source in (path, "x" * 5000, b"a\xff"):
        code, out, err = repo.update(state, source)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert err[:-1].isprintable()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_root_leaves_files_to_the_owner_of_the_folder_and_follows_no_link(repo: Repo, new: Path) -> None:
    os.chown(new, 65534, 65534)
    repo.updated(new)
    assert {(new / name).stat().st_uid for name in ("state.json", "decisions.log")} == {65534}
    (new / "decisions.log").unlink()
    (new / "decisions.log").symlink_to(repo.folder / "victim")
    with pytest.raises(Exception, match="cannot be written"):
        add_decision(new, "x", "y", datetime.now(UTC))
    assert not (repo.folder / "victim").exists()


def test_two_commands_at_once_are_both_done(repo: Repo, new: Path) -> None:
    layout = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
    words = ["update", str(repo.path), "--state", str(new), "--layout", str(layout)]
    command = [sys.executable, "-m", "ecu_node", *words]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(2)]
    outputs = sorted(process.communicate(timeout=120)[0].decode()[:8] for process in both)
    assert outputs == ["nothing ", "on trial"]


def test_inspect_and_report_say_what_the_vehicle_holds(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.offer(other)
    repo.updated(state)
    code, out, _ = repo.node("inspect", "--state", state)
    assert code == 0
    for words in ("vehicle v1; trusts root 1", "in force: parameter set 300", "on trial: parameter set 301"):
        assert words in out
    code, out, _ = repo.node("report", "--state", state, "--key", repo.key("new"))
    envelope = Envelope.from_dict(msgspec.json.decode(out))
    envelope.verify([public_key_of(repo.folder / "keys" / "new.pub")], 1)
    facts = msgspec.json.decode(envelope.payload)
    assert (facts["vehicle"], facts["in_force"]["parameter_set"]) == ("v1", 300)
    assert msgspec.json.decode(repo.node("report", "--state", state)[1])["on_trial"] == facts["on_trial"]


def test_inspect_fails_where_the_set_in_force_has_expired(
    state: Path, repo: Repo, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = read_state(state)
    assert found.in_force is not None
    late: VehicleState = replace(found, latest=found.in_force.expires)
    monkeypatch.setattr("ecu_node.update.state.read_state", lambda _: late)
    code, _, err = repo.node("inspect", "--state", state)
    assert code == 1
    assert "expired at" in err
