"""The attacks that TUF lists, through the command line: each is refused in one line, and the state stays as it is."""

import lzma
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from tuf.api.metadata import Key, MetaFile, Snapshot, SuccinctRoles, Targets

from ecu_node.parameters import VehicleParameters, encode_parameters
from ecu_node.update.signers import public_key_of
from ecu_node.update.sources import bundle_bytes
from tests.update.repo import Repo, expired


def test_changed_parameter_file_is_refused(repo: Repo, new: Path) -> None:
    (target,) = (repo.path / "targets").glob("*.v1.json")
    content = target.read_bytes()
    target.write_bytes(content.replace(b"0.05", b"0.06"))
    repo.refused(new, "Observed hash")
    target.write_bytes(content[:-1])
    repo.refused(new, "Observed length")


@pytest.mark.parametrize("role", ["root", "timestamp", "snapshot", "targets", "bin"])
def test_metadata_of_foreign_keys_is_refused(role: str, repo: Repo, state: Path, other: VehicleParameters) -> None:
    repo.offer(other)
    role = repo.bin if role == "bin" else role
    repo.forge(role, lambda _: None, "mallory", bump=role == "root")
    if role == "snapshot":
        repo.point("timestamp")
    repo.refused(state, "was signed by 0/")


def test_bundle_older_than_the_accepted_metadata_is_refused(repo: Repo, state: Path) -> None:
    """Otherwise an old bundle could hide a revocation."""
    old = repo.bundle().read_bytes()
    repo.revoke()
    assert "nothing is in force now" in repo.updated(state, repo.bundle())
    repo.bundle().write_bytes(old)
    repo.refused(state, "older than what was accepted before", repo.folder / "bundles" / "v1.json.xz")


def test_rollback_of_the_metadata_of_a_single_bin_is_refused(repo: Repo, state: Path, other: VehicleParameters) -> None:
    """The attacker has the keys of snapshot and timestamp."""
    repo.take(state, other)

    def back(snapshot: Snapshot) -> None:
        snapshot.meta[f"{repo.bin}.json"].version -= 1

    repo.forge("snapshot", back, "snapshot")
    repo.point("timestamp")
    repo.refused(state, "older than what was accepted before")


@pytest.mark.parametrize("role", ["timestamp", "snapshot", "targets", "bin", "root"])
def test_expired_metadata_of_any_role_is_refused(role: str, repo: Repo, new: Path) -> None:
    role = repo.bin if role == "bin" else role
    repo.forge(role, expired, "r1", "r2", "t1", "t2", "snapshot", "timestamp", bump=role in ("root", "timestamp"))
    if role == "snapshot":
        repo.point("timestamp")
    repo.refused(new, "expired")


def test_oversized_metadata_and_bundles_are_refused(repo: Repo, new: Path) -> None:
    os.truncate(repo.metadata / "timestamp.json", 1 << 30)
    repo.refused(new, "larger than")
    os.truncate(repo.metadata / "timestamp.json", 100_000)
    repo.refused(new, "exceeding the maximum allowed length")
    bomb = repo.folder / "bomb.json.xz"
    bomb.write_bytes(lzma.compress(b'{"a": "' + bytes(9_000_000) + b'"}', check=lzma.CHECK_SHA256))
    assert bomb.stat().st_size < 20_000
    repo.refused(new, "not a whole bundle: something is missing, or too much is there", bomb)
    os.truncate(bomb, 1 << 30)
    repo.refused(new, "larger than", bomb)


def test_mixture_of_old_and_new_metadata_is_refused(repo: Repo, new: Path, other: VehicleParameters) -> None:
    """Old metadata of a bin under a new snapshot, and a new target under an old bin."""
    old = repo.live(repo.bin).read_bytes()
    repo.offer(other)
    whole = repo.live(repo.bin).read_bytes()
    repo.live(repo.bin).write_bytes(old)
    repo.refused(new, "Expected")
    repo.live(repo.bin).write_bytes(whole)
    first, second = sorted((repo.path / "targets").glob("*.v1.json"))
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    repo.refused(new, "Observed ")


def test_bundle_or_repository_without_this_vehicle_is_refused(repo: Repo, new: Path, tmp_path: Path) -> None:
    words = "is not in the bundle, which has v2.json; is it complete, and for vehicle 'v1', which this is?"
    repo.refused(new, words, repo.bundle("v2"))
    repo.provision(tmp_path / "v9", "v9")
    repo.refused(tmp_path / "v9", "nothing is published for vehicle 'v9' yet")
    assert '"NoParameters"' in (tmp_path / "v9" / "decisions.log").read_text()
    repo.forge(repo.bin, lambda targets: targets.targets.clear(), "t1", "t2")
    repo.relist(repo.bin, "snapshot", "timestamp")
    repo.refused(new, "nothing is published for vehicle 'v1' yet")
    repo.live(repo.bin).unlink()
    repo.refused(new, f"{repo.bin}.json is not in the folder; is it complete")


def test_parameters_of_another_vehicle_under_this_name_are_refused(repo: Repo, new: Path) -> None:
    """The attacker has the keys of targets, snapshot and timestamp."""
    repo.forge(repo.bin, lambda targets: targets.targets["v1.json"].custom.update(vehicle="v2"), "t1", "t2")
    repo.relist(repo.bin, "snapshot", "timestamp")
    repo.refused(new, "the parameters are for 'v2', this is 'v1'")


STOLEN = [("timestamp", "mallory"), ("snapshot", "mallory"), ("t1", "mallory"), ("r1",), ("snapshot", "timestamp")]


@pytest.mark.parametrize("keys", STOLEN)
def test_one_stolen_key_cannot_deliver_parameters(keys: tuple[str, ...], repo: Repo, new: Path) -> None:
    """Nor can the keys of snapshot and timestamp together. The thief signs whatever the stolen keys can sign."""
    repo.forge(repo.bin, lambda _: None, *keys)
    repo.relist(repo.bin, *keys)
    repo.refused(new, "was signed by ")


LEADING_OUT = [
    ("bins/../../..", "metadata/1.bins%2F..%2F..%2F..-1.json is not in the folder"),
    ("../../../secret", "leads out of the repository"),
]


@pytest.mark.parametrize(("name", "words"), LEADING_OUT)
def test_names_in_metadata_cannot_lead_out_of_the_repository(name: str, words: str, repo: Repo, new: Path) -> None:
    """The attacker has the keys of targets, snapshot and timestamp."""

    def lead_out(targets: Targets) -> None:
        targets.targets["v1.json"].hashes = {"sha256": name}

    def lead_out_of_bins(targets: Targets) -> None:
        key: Key = public_key_of(repo.folder / "keys" / "t1.pub")
        assert targets.delegations is not None
        targets.delegations.keys = {key.keyid: key}
        targets.delegations.succinct_roles = SuccinctRoles([key.keyid], 1, 1, name)

    role, change = (repo.bin, lead_out) if name.startswith("..") else ("targets", lead_out_of_bins)
    repo.forge(role, change, "t1", "t2")
    repo.relist(role, "snapshot", "timestamp")
    repo.forge("snapshot", lambda snapshot: snapshot.meta.update({f"{name}-1.json": MetaFile(1)}), "snapshot")
    repo.point("timestamp")
    repo.refused(new, words)


class _Handler(SimpleHTTPRequestHandler):
    def copyfile(self, source: Any, outputfile: Any) -> None:
        with suppress(ConnectionError):  # a client that has seen enough
            super().copyfile(source, outputfile)

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002
        pass


@pytest.fixture
def server(repo: Repo) -> Iterator[str]:
    """Address of a web server that has the repository."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=repo.path)) as served:
        thread = Thread(target=served.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{served.server_address[1]}"
        served.shutdown()
        thread.join()


def test_downloads_are_limited(repo: Repo, new: Path, server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    timestamp = repo.metadata / "timestamp.json"
    whole = timestamp.read_bytes()
    os.truncate(timestamp, 10_000_000)
    repo.refused(new, "exceeding the maximum allowed length", server)
    timestamp.write_bytes(whole)
    with monkeypatch.context() as patch:
        patch.setattr("ecu_node.update.sources._LONGEST_DOWNLOAD_S", 0.0)
        repo.refused(new, "took longer than 0 s; check address and connection", server)
    assert repo.updated(new, server).startswith("on trial: ")
    shutil.rmtree(repo.metadata)
    repo.refused(new, "status 404; is it complete", server)
    repo.refused(new, "Connection refused; check address and connection, or whether it", "http://127.0.0.1:1/x")
    repo.refused(new, "only http:// and https:// are known", "ftp://127.0.0.1/x")


@pytest.mark.parametrize("vehicle", ["V 1", "Ü#1", "a/b", "50%"])
def test_vehicle_of_any_name_updates_from_a_web_server(
    vehicle: str, repo: Repo, server: str, parameters: VehicleParameters, tmp_path: Path
) -> None:
    path = tmp_path / "parameters.json"
    path.write_bytes(encode_parameters(replace(parameters, vehicle=vehicle), ""))
    repo.done("add", repo.path, path)
    repo.publish()
    repo.provision(tmp_path / "state", vehicle)
    assert repo.updated(tmp_path / "state", server).startswith("on trial: ")


def test_additional_files_in_a_bundle_are_not_written(repo: Repo, new: Path, parameters: VehicleParameters) -> None:
    """Names in a bundle are only looked up; no file is written under one."""
    files = msgspec.json.decode(lzma.decompress(repo.bundle().read_bytes()), type=dict[str, str])
    evil = {"../../evil": "x", "/tmp/evil": "x", "targets/v1.json": encode_parameters(parameters, "f").decode()}
    path = repo.folder / "evil.json.xz"
    path.write_bytes(bundle_bytes({name: text.encode() for name, text in {**files, **evil}.items()}))
    assert repo.updated(new, path).startswith("on trial: ")
    assert not (repo.folder / "evil").exists()
