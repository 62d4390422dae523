"""Updates from an honest repository: our own checks, revocation, time, and damaged files."""

import lzma
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
from tuf.api.metadata import Metadata, TargetFile

from ecu_node.core.status import TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import FileReference, VehicleParameters
from ecu_node.update.client import update
from ecu_node.update.signers import public_key_of
from ecu_node.update.sources import open_source
from ecu_node.update.state import ParameterSet, add_decision, read_state, state_path
from ecu_node.update.store import conclude, end_expired
from tests.disk import full_disk
from tests.ecu_node.processes import Done
from tests.ecu_node.vehicles import LAYOUT
from tests.update.damage import a_folder, a_pipe, cut, huge, without, zeros
from tests.update.repo import Repo, drifting, one_line, pass_trial

DIGEST = "0" * 64
Change = Callable[[VehicleParameters], VehicleParameters]


def held_set(state: Path, place: str = "in_force") -> ParameterSet:
    found = getattr(read_state(state), place)
    assert isinstance(found, ParameterSet)
    return found


def numbers(state: Path) -> list[int | None]:
    """Numbers of the parameter sets in force, on trial and in force before; None where there is none."""
    found = read_state(state)
    return [item.parameters.number if item else None for item in (found.in_force, found.on_trial, found.before)]


def test_set_is_on_trial_then_in_force_and_the_old_one_is_kept(repo: Repo, new: Path, other: VehicleParameters) -> None:
    repo.updated(new)
    assert numbers(new)[:2] == [None, 300]
    pass_trial(new)
    repo.take(new, other)
    assert numbers(new)[:2] == [300, 301]
    assert "301 (" in repo.updated(new), "again: nothing new"
    pass_trial(new)
    assert numbers(new) == [301, None, 300]


def test_failed_set_is_removed_and_not_tried_again(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.take(state, other)
    pass_trial(state, passed=False)
    assert numbers(state)[:2] == [300, None]
    one_line(repo.update(state), "has failed its trial here")
    repo.offer(other, "--days", 100)  # published anew
    assert repo.updated(state).startswith("on trial: ")


def test_result_of_a_replaced_trial_is_ignored(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.take(state, other)
    tried = held_set(state, "on_trial")
    repo.take(state, replace(other, number=302))
    conclude(state, tried, passed=True, text="seen", now=datetime.now(UTC))
    assert numbers(state)[:2] == [300, 302]


UNFIT = [
    (lambda p: replace(p, layout=FileReference(name="l", sha256=DIGEST)), "layout"),
    (lambda p: replace(p, dbc=FileReference(name="d", sha256=DIGEST)), "DBC"),
    (lambda p: drifting(p, 0.5), "drift"),
    (lambda p: drifting(p, 0.05 - 0.22), "differs from the set in force"),
]


@pytest.mark.parametrize(("change", "words"), UNFIT)
def test_set_that_does_not_fit_is_refused(
    change: Change, words: str, repo: Repo, state: Path, parameters: VehicleParameters
) -> None:
    repo.offer(change(parameters))
    one_line(repo.update(state), words, repo.path)
    assert numbers(state)[:2] == [300, None]
    assert words in (state / "decisions.log").read_text().splitlines()[-1]


def test_large_step_is_taken_if_the_signers_allow_it(repo: Repo, state: Path, parameters: VehicleParameters) -> None:
    assert repo.take(state, drifting(parameters, -0.17), "--allow-large-step").startswith("on trial: ")


def test_previous_set_replaces_a_revoked_one(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.take(state, other)
    pass_trial(state)
    repo.revoke()
    assert "parameter set 300 (" in repo.updated(state)
    assert numbers(state)[:2] == [300, None]
    assert repo.updated(state).startswith("nothing new: ")


def test_revoked_set_ends_while_a_new_one_goes_on_trial(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.add(other)
    repo.revoke("--sha256", held_set(state).sha256)
    text = repo.updated(state)
    assert "nothing is in force now" in text
    assert "on trial: parameter set 301" in text
    assert numbers(state)[:2] == [None, 301]


def test_revocation_applies_if_the_new_set_is_refused(repo: Repo, state: Path, parameters: VehicleParameters) -> None:
    repo.add(drifting(parameters, 0.5))
    repo.revoke("--sha256", held_set(state).sha256)
    one_line(repo.update(state), "nothing is in force now")
    assert numbers(state)[:2] == [None, None]
    lines = [msgspec.json.decode(line) for line in (state / "decisions.log").read_text().splitlines()[-2:]]
    events = [(line["event"], line.get("reason")) for line in lines]
    assert events == [("revoked", None), ("refused", "ImplausibleParameters")]


def test_none_of_many_revocations_is_forgotten(repo: Repo, state: Path) -> None:
    """Version 1.0 forgot the first of 65."""
    repo.done("revoke", repo.path, "v1")
    for number in range(65):
        (repo.path / "targets" / f"{number:064x}.v1.json").touch()
        repo.done("revoke", repo.path, "v1", "--sha256", f"{number:064x}")
    repo.publish()
    assert "nothing is in force now" in repo.updated(state)


def test_same_set_with_later_expiry_needs_no_trial(
    repo: Repo, state: Path, parameters: VehicleParameters, other: VehicleParameters
) -> None:
    assert repo.updated(state).startswith("nothing new: parameter set 300 (")
    repo.take(state, other)
    assert repo.take(state, parameters, "--days", 800).startswith("extended: parameter set 300")
    assert numbers(state)[:2] == [300, None]
    assert held_set(state).expires > datetime.now(UTC) + timedelta(days=799)


def test_dry_run_of_an_update_writes_nothing(repo: Repo, new: Path) -> None:
    before = {path.name: path.read_bytes() for path in new.iterdir()}
    code, out, _ = repo.update(new, None, "--dry-run")
    assert code == 0
    assert out.startswith("dry run, nothing is changed: on trial: parameter set 300")
    assert {path.name: path.read_bytes() for path in new.iterdir()} == before


def test_expired_set_is_not_used(repo: Repo, state: Path, database: VehicleDatabase, other: VehicleParameters) -> None:
    now = datetime.now(UTC)
    repo.offer(other, "--days", 1)
    update(state, str(repo.path), database, now)
    tried = held_set(state, "on_trial")
    conclude(state, tried, passed=True, text="seen", now=now + timedelta(days=2))
    assert numbers(state)[:2] == [300, None], "it expired before its trial ended"
    assert read_state(state).latest < now + timedelta(days=1), "a clock that jumped ahead is not kept"
    assert update(state, str(repo.path), database, now).startswith("on trial"), "nor has the set failed by it"
    conclude(state, tried, passed=True, text="seen", now=now + timedelta(days=2))
    with pytest.raises(TrustError, match="expired at"):
        update(state, str(repo.path), database, now + timedelta(days=40))  # the timestamp has expired by then
    found = held_set(state)
    end_expired(state, tried, tried.expires)
    assert numbers(state)[:2] == [300, None], "another set is in force"
    end_expired(state, found, found.expires)
    assert numbers(state)[:2] == [None, None]
    assert read_state(state).ended == "expired"


def test_expired_offer_stays_refused_if_the_clock_is_set_back(
    repo: Repo, state: Path, database: VehicleDatabase, other: VehicleParameters
) -> None:
    now = datetime.now(UTC)
    repo.offer(other, "--days", 1)
    with pytest.raises(TrustError, match="expired at"):
        update(state, str(repo.path), database, now + timedelta(days=2))
    with pytest.raises(TrustError, match="the latest time seen here is"):
        update(state, str(repo.path), database, now)


def test_canonical_json_equals_that_of_securesystemslib(offered: Repo) -> None:
    """The fast encoder used here writes keys, numbers, escapes and unusual characters in the same way."""
    documents = [Metadata.from_file(str(path)).signed.to_dict() for path in offered.metadata.glob("*.json")]
    odd = {"b": [], "a": {}, "é": "\x7f€\U0001f697/<&'", "": [True, False, 0, -1, 2**63], "A": [[{"z": "", "y": 1}]]}
    for document in (*documents, odd, {**odd, "n": None}, {**odd, "c": 'a "b"\\\n\x00'}):
        assert tuf_json.encode_canonical(document) == encode_canonical(document)
    with pytest.raises(FormatError):
        tuf_json.encode_canonical({"length": math.nan})


def test_vehicle_is_provisioned_once_and_with_a_signed_root(repo: Repo, state: Path, tmp_path: Path) -> None:
    place, root = tmp_path / "fresh", tmp_path / "root.json"

    def refused(words: str, path: Path = root, folder: Path = place) -> None:
        one_line(repo.node("provision", "--vehicle", "v1", "--root", path, "--state", folder), words)

    for content in (b"", b"{}", b"\xff", repo.live("targets").read_bytes()):
        root.write_bytes(content)
        refused("1.root.json of 'calibrator repository init' is expected")
    a_pipe(root)
    refused("cannot read the root: it is a pipe")
    refused("there is a state already; a new root comes with 'ecu-node update'", repo.live("root"), state)
    refused("cannot be made: Not a directory; choose another --state", repo.live("root"), state / "state.json" / "x")
    assert not place.exists()
    with full_disk(100):
        refused("state.json: cannot be written: File too large; the state is as before", repo.live("root"))
    assert not state_path(place).exists()
    repo.forge("root", lambda _: None, "r1", "mallory", bump=False)
    refused("is expected", repo.live("root"))


INCONSISTENT = [
    (lambda file: file.custom.update(expires="2100-01-01T00:00:00"), "v1.json: Expected `datetime` with a time"),
    (lambda file: file.custom.update(layout=DIGEST), "layout and DBC are not those of the signed description"),
    (lambda file: setattr(file, "length", 1_000_001), "v1.json is no parameter file"),
    (lambda file: file.hashes.update(sha512=DIGEST), "v1.json is no parameter file"),
]


@pytest.mark.parametrize(("change", "words"), INCONSISTENT)
def test_signed_but_inconsistent_description_is_refused(
    change: Callable[[TargetFile], object], words: str, repo: Repo, new: Path
) -> None:
    repo.forge(repo.bin, lambda targets: change(targets.targets["v1.json"]), "t1", "t2")
    repo.relist(repo.bin, "snapshot", "timestamp")
    one_line(repo.update(new), words)
    assert numbers(new)[:2] == [None, None]


@pytest.mark.parametrize("damage", [without, cut, zeros, a_folder, a_pipe, huge])
def test_damaged_bundle_or_state_is_refused(damage: Callable[[Path], None], repo: Repo, state: Path) -> None:
    bundle = repo.bundle()
    damage(bundle)
    repo.refused(state, str(bundle), bundle)
    damage(state / "state.json")
    for found in (repo.update(state), repo.node("inspect", "--state", state)):
        one_line(found, "provision")


def test_flipped_bit_in_state_json_is_refused_as_damage(state: Path) -> None:
    content = (state / "state.json").read_bytes()
    for place in range(0, len(content), 61):
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        (state / "state.json").write_bytes(damaged)
        with pytest.raises(TrustError, match="damaged"):
            read_state(state)


def test_change_of_any_byte_of_a_bundle_is_detected(repo: Repo, new: Path) -> None:
    """Each byte of head and tail, and every seventh between, is changed, or is the last one of a cut bundle."""
    content, path = repo.bundle().read_bytes(), repo.folder / "changed"
    places = sorted({*range(64), *range(0, len(content), 7), *range(len(content) - 64, len(content))})
    weak = lzma.compress(lzma.decompress(content))  # whole, but checked by CRC-64 alone
    changed = [content[:k] + bytes([content[k] ^ 1 << k % 8]) + content[k + 1 :] for k in places]
    for item in (*changed, *(content[:length] for length in places), content + b"\0", content + content, weak):
        path.write_bytes(item)
        with pytest.raises(TrustError, match="not a whole bundle") as caught:
            open_source(str(path))
        assert str(caught.value).isprintable()
    repo.refused(new, "not a whole bundle", path)


def test_unusable_source_or_state_is_refused_in_one_line(repo: Repo, state: Path) -> None:
    for source in (repo.folder / "a\nb\x1b[2J", "x" * 5000, b"a\xff"):
        one_line(repo.update(state, source))
    one_line(repo.node("inspect", "--state", state / "state.json"), "cannot read the state: Not a directory")
    a_pipe(state / "lock")
    one_line(repo.update(state), f"{state}: cannot be used as state: it is no file; remove it\n")


def test_update_without_package_tuf_is_refused_in_one_line(state: Path) -> None:
    code = "import sys; sys.modules['tuf'] = None; from ecu_node.__main__ import ecu_node_program as run; exit(run())"
    command = [sys.executable, "-c", code, "update", "none", "--state", state, "--layout", LAYOUT]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120, check=False)
    found = Done(done.returncode, done.stdout, done.stderr)
    one_line(found, "updates need the package tuf", ": pip install 'hv-current-correction[update]'\n")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_root_gives_files_to_the_owner_of_the_folder_and_follows_no_link(repo: Repo, new: Path) -> None:
    os.chown(new, 65534, 65534)
    repo.updated(new)
    assert {(new / name).stat().st_uid for name in ("state.json", "decisions.log")} == {65534}
    (new / "decisions.log").unlink()
    (new / "decisions.log").symlink_to(repo.folder / "victim")
    with pytest.raises(UserError, match="cannot be written"):
        add_decision(new, "x", "y", datetime.now(UTC))
    assert not (repo.folder / "victim").exists()
    (new / "decisions.log").unlink()
    (repo.folder / "of root").touch()
    (new / "decisions.log").hardlink_to(repo.folder / "of root")
    with pytest.raises(UserError, match="it is another name of somebody else's file; remove it"):
        add_decision(new, "x", "y", datetime.now(UTC))
    assert (repo.folder / "of root").stat().st_uid == 0


def test_inspect_and_report_show_the_sets_and_the_root(repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.take(state, other)
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


def test_inspect_fails_if_the_set_in_force_expired(state: Path, repo: Repo, monkeypatch: pytest.MonkeyPatch) -> None:
    late = replace(read_state(state), latest=held_set(state).expires)
    monkeypatch.setattr("ecu_node.update.state.read_state", lambda _: late)
    code, _, err = repo.node("inspect", "--state", state)
    assert code == 1
    assert "expired at" in err
