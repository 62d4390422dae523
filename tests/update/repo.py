"""A repository with its keys, a vehicle that trusts it, and an attacker who has some of the keys."""

import os
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import Any

from msgspec.structs import replace
from tuf.api.metadata import Metadata, MetaFile, Snapshot, SuccinctRoles, Timestamp
from tuf.api.serialization.json import JSONSerializer

from ecu_node.parameters import VehicleParameters, write_parameters
from ecu_node.update.signers import signer_of
from ecu_node.update.state import read_state
from ecu_node.update.store import conclude
from tests.calibrator.command_here import calibrator as calibrator_here
from tests.ecu_node.processes import Done, ecu_node
from tests.ecu_node.vehicles import LAYOUT

VEHICLE = "v1"
ALL = ("r1", "r2", "t1", "t2", "snapshot", "timestamp")
"""Names of the keys in the folder of a repository."""


def calibrator(*arguments: object) -> Done:
    """Run a command of the calibrator in this process."""
    done = calibrator_here(*(os.fsdecode(item) if isinstance(item, bytes) else item for item in arguments))
    return Done(done.returncode, done.stdout, done.stderr)


def drifting(parameters: VehicleParameters, drift: float) -> VehicleParameters:
    """Parameters with another gain error of the battery's sensor."""
    battery = replace(parameters.branches["battery"], drift=drift)
    return replace(parameters, branches={**parameters.branches, "battery": battery})


def pass_trial(state: Path, *, passed: bool = True) -> None:
    """End the trial of a vehicle, as its node does after a drive."""
    on_trial = read_state(state).on_trial
    assert on_trial is not None
    conclude(state, on_trial, passed=passed, text="seen", now=datetime.now(UTC))


def one_line(found: Done, *words: object) -> None:
    """Require that a command failed in one line with these words."""
    code, out, err = found
    assert (code, out, err.count("\n"), err[:-1].isprintable()) == (1, "", 1, True), (out, err)
    assert err.startswith("ecu-node: ")
    assert [word for word in words if str(word) not in err] == [], err


class Repo:
    """A repository in ``folder / "repo"``, its keys in ``folder / "keys"``; the commands make it."""

    calibrator, node = staticmethod(calibrator), staticmethod(ecu_node)

    def __init__(self, folder: Path) -> None:
        self.folder, self.vehicle = folder, VEHICLE
        self.path, self.metadata = folder / "repo", folder / "repo" / "metadata"

    def done(self, *words: object) -> str:
        """Run ``calibrator repository``, which must succeed."""
        code, out, err = self.calibrator("repository", *words)
        assert code == 0, err
        return out

    def create(self) -> None:
        keys = self.folder / "keys"
        for name in (*ALL, "mallory", "new"):
            self.done("key", name, "--no-passphrase", "--out", keys)
        roles = {"root": ("r1", "r2"), "targets": ("t1", "t2"), "snapshot": ("snapshot",), "timestamp": ("timestamp",)}
        options = [(f"--{role}", keys / f"{name}.pub") for role, names in roles.items() for name in names]
        self.done("init", self.path, *chain(*options))

    def key(self, name: str) -> Path:
        return self.folder / "keys" / f"{name}.key"

    def publish(self, *names: str) -> None:
        self.done("publish", self.path, *(word for name in names or ALL for word in ("--key", self.key(name))))

    def add(self, parameters: VehicleParameters, *options: object, vehicle: str = VEHICLE) -> None:
        path = self.folder / f"{vehicle}.json"
        write_parameters(replace(parameters, vehicle=vehicle), path)
        self.done("add", self.path, path, *options)

    def offer(self, parameters: VehicleParameters, *options: object, vehicle: str = VEHICLE) -> None:
        self.add(parameters, *options, vehicle=vehicle)
        self.publish()

    def take(self, state: Path, parameters: VehicleParameters, *options: object) -> str:
        """Let the vehicle update to parameters that are offered now."""
        self.offer(parameters, *options)
        return self.updated(state)

    def revoke(self, *options: object) -> None:
        self.done("revoke", self.path, VEHICLE, *options)
        self.publish()

    def bundle(self, vehicle: str = VEHICLE) -> Path:
        self.done("bundle", self.path, vehicle, "--out", self.folder / "bundles")
        return self.folder / "bundles" / f"{vehicle}.json.xz"

    def provision(self, state: Path, vehicle: str = VEHICLE) -> None:
        root = self.metadata / "1.root.json"
        code, _, err = self.node("provision", "--vehicle", vehicle, "--root", root, "--state", state)
        assert code == 0, err

    def update(self, state: Path, source: object = None, *options: object) -> Done:
        source = self.path if source is None else source
        return self.node("update", source, "--state", state, "--layout", LAYOUT, *options)

    def updated(self, state: Path, source: object = None) -> str:
        code, out, err = self.update(state, source)
        assert code == 0, err
        return out

    def refused(self, state: Path, words: str, source: object = None) -> None:
        """Require that an update is refused in one line, and that nothing has changed."""
        before = (state / "state.json").read_bytes()
        one_line(self.update(state, source), words)
        assert (state / "state.json").read_bytes() == before
        assert words in (state / "decisions.log").read_text().splitlines()[-1]

    def copy(self, place: Path) -> "Repo":
        """Copy the repository and its keys into another folder."""
        shutil.copytree(self.path, place / "repo")
        shutil.copytree(self.folder / "keys", place / "keys")
        return Repo(place)

    def live(self, role: str) -> Path:
        """Newest metadata of a role."""
        if role == "timestamp":
            return self.metadata / "timestamp.json"
        return max(self.metadata.glob(f"*.{role}.json"), key=lambda path: int(path.name.partition(".")[0]))

    @property
    def bin(self) -> str:
        """The bin that holds the vehicle."""
        return SuccinctRoles([], 1, 11, "bins").get_role_for_target(f"{self.vehicle}.json")

    def forge(self, role: str, change: Callable[[Any], object], *names: str, bump: bool = True) -> None:
        """Change metadata in place, with a higher version, and sign it with these keys alone."""
        path = self.live(role)
        metadata: Metadata[Any] = Metadata.from_file(str(path))
        change(metadata.signed)
        metadata.signed.version += bump
        metadata.signatures.clear()
        for name in names:
            metadata.sign(signer_of(str(self.key(name))), append=True)
        name = "timestamp.json" if role == "timestamp" else f"{metadata.signed.version}.{role}.json"
        metadata.to_file(str(self.metadata / name), JSONSerializer(compact=True))

    def relist(self, role: str, *names: str) -> None:
        """Let snapshot and timestamp name the newest metadata of a role, signed with these keys."""

        def list_role(snapshot: Snapshot) -> None:
            snapshot.meta[f"{role}.json"] = MetaFile(int(self.live(role).name.partition(".")[0]))

        self.forge("snapshot", list_role, *names)
        self.point(*names)

    def point(self, *names: str) -> None:
        """Let the timestamp name the newest snapshot."""

        def name_snapshot(timestamp: Timestamp) -> None:
            path = self.live("snapshot")
            timestamp.snapshot_meta = MetaFile.from_data(int(path.name.split(".")[0]), path.read_bytes(), ["sha256"])

        self.forge("timestamp", name_snapshot, *names)


def expired(signed: Any) -> None:
    """Change that makes metadata expire a second ago."""
    signed.expires = datetime.now(UTC).replace(microsecond=0) - timedelta(seconds=1)
