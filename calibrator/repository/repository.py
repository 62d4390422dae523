"""A TUF repository of parameter files: one target per vehicle; the hash of its name says in which bin it is listed.

    metadata/    what vehicles read: N.root.json, N.targets.json, N.bins-XXX.json, N.snapshot.json, timestamp.json
    targets/     parameter files, SHA256.VEHICLE.json
    staged/      the next versions of root, targets and bins, with the signatures that they have so far

Nothing that vehicles see changes until all that is staged has enough signatures: then :meth:`Repository.publish` puts
it in place, timestamp last. So signers may sign one after the other, each on a machine of their own.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace
from securesystemslib.signer import Key, Signer, SSlibKey
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import (
    Delegations,
    Metadata,
    MetaFile,
    Root,
    Signed,
    Snapshot,
    SuccinctRoles,
    TargetFile,
    Targets,
    Timestamp,
)
from tuf.api.serialization.json import JSONSerializer

from calibrator.errors import RepositoryStateError
from calibrator.files.folders import write_files
from calibrator.terminal.text import counted
from ecu_node.core.status import UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import check_fit, decode_parameters, parameter_bytes
from ecu_node.update.client import TargetFacts, expiry_of, target_path
from ecu_node.update.sources import bundle_bytes

__all__ = ["BIN_BITS", "ROLES", "NewKeys", "Repository", "missing_text"]

ROLES = ("root", "targets", "snapshot", "timestamp")
BIN_BITS = 11
"""Bits of a bin's number, for 2048 bins: with 10^6 vehicles a bundle has about 20 kB, and the snapshot is still read in
milliseconds."""
_BINS = SuccinctRoles([], 1, BIN_BITS, "bins")
_DAYS = {"root": 730, "targets": 730, "bins": 400, "snapshot": 60, "timestamp": 30}
"""How long metadata is valid. [d]"""
_RENEW_DAYS = 60
"""Root, targets and bins that expire within this time are staged anew, to be signed again. [d]"""

_SHOWN = 4
"""Most roles that a message names: all of a new repository. [1]"""

_KINDS: Mapping[str, type[Signed]] = {"root": Root, "snapshot": Snapshot, "timestamp": Timestamp}
"""Class of the metadata of each role; for all other roles it is :class:`Targets`."""


class NewKeys(NamedTuple):
    """Public keys of a role, and how many of them must sign."""

    keys: Sequence[SSlibKey]
    threshold: int


def _expiry(role: str) -> datetime:
    days = _DAYS["bins" if role.startswith("bins-") else role]
    return (datetime.now(UTC) + timedelta(days=days)).replace(microsecond=0)


class Repository:
    """The repository in a folder.

    Parameters
    ----------
    folder : Path
        The folder, made by :meth:`create`.

    Raises
    ------
    RepositoryStateError
        If there is no repository, or it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._metadata, self._staged = folder, folder / "metadata", folder / "staged"
        names = [path.name.partition(".")[0] for path in self._metadata.glob("*.root.json")]
        roots = [int(name) for name in names if name.isdecimal()]
        if not roots and not (self._staged / "root.json").exists():
            raise RepositoryStateError(f"{folder}: no repository; make one with 'calibrator repository init'")
        self._root_version = max(roots, default=0)
        self.waiting: dict[str, str] = {}
        """Roles that lack signatures after :meth:`sign`, with a text that says which are missing."""
        self._staged_versions: dict[str, int] = {}
        self._versions: dict[str, int] = {}
        self._snapshot_version = self._timestamp_version = 0
        if (self._metadata / "timestamp.json").exists():
            timestamp = self._read(self._metadata / "timestamp.json").signed
            self._timestamp_version, self._snapshot_version = timestamp.version, timestamp.snapshot_meta.version
            snapshot = self._read(self._metadata / f"{self._snapshot_version}.snapshot.json").signed
            self._versions = {name.removesuffix(".json"): item.version for name, item in snapshot.meta.items()}

    @classmethod
    def create(cls, folder: Path, roles: Mapping[str, NewKeys]) -> "Repository":
        """Stage the first root and the first targets of a new repository.

        Parameters
        ----------
        folder : Path
            New or empty folder.
        roles : mapping of str to NewKeys
            Keys for each of :data:`ROLES`.

        Raises
        ------
        RepositoryStateError
            If the folder exists and is not empty.
        """
        if folder.exists() and any(folder.iterdir()):
            raise RepositoryStateError(f"{folder}: exists and is not empty; choose another folder")
        for name in ("metadata", "targets", "staged"):
            (folder / name).mkdir(parents=True)
        root = Root(version=1, expires=_expiry("root"), consistent_snapshot=True)
        for role, new in roles.items():
            _set_keys(root, role, new)
        targets = Targets(version=1, expires=_expiry("targets"))
        _delegate(targets, roles["targets"])
        files = {"targets": _encoded(Metadata(targets)), "root": _encoded(Metadata(root))}  # the root makes it complete
        write_files({folder / "staged" / f"{role}.json": content for role, content in files.items()})
        return cls(folder)

    def _read(self, path: Path) -> Metadata[Any]:
        """Read the metadata of the role after which the file is named."""
        with _readable(path):
            found: Metadata[Any] = Metadata.from_file(str(path))
            if not isinstance(found.signed, _KINDS.get(path.stem.rpartition(".")[2], Targets)):
                raise ValueError("it is of another role")
        return found

    def _live(self, role: str) -> Any:
        """Return the published metadata of a role, which vehicles see; None before the first publication."""
        version = self._root_version if role == "root" else self._versions.get(role, 0)
        return self._read(self._metadata / f"{version}.{role}.json").signed if version else None

    def _latest(self, role: str) -> Any:
        """Return the staged metadata of a role, else the published; None without either, never for root or targets."""
        path = self._staged / f"{role}.json"
        return self._read(path).signed if path.exists() else self._live(role)

    def _stage(self, role: str, signed: Signed) -> None:
        """Stage the next version of a role; signatures of a version staged before are lost."""
        live = self._root_version if role == "root" else self._versions.get(role, 0)
        signed.version, signed.expires = live + 1, _expiry(role)
        _write(self._staged / f"{role}.json", _encoded(Metadata[Any](signed)))

    def add(
        self, files: Iterable[Path], *, days: int, allow_large_step: bool, database: VehicleDatabase | None = None
    ) -> tuple[int, list[str]]:
        """Stage parameter files, each in place of the one that its vehicle had before.

        Parameters
        ----------
        files : iterable of Path
            Parameter files, one per vehicle.
        days : int
            How long they may be used. [d]
        allow_large_step : bool
            Whether they may differ a lot from the parameters in force, as after a repair.
        database : VehicleDatabase or None
            Layout and DBC that they must fit; None: only the vehicles check that.

        Returns
        -------
        bins : int
            Number of bins that are staged now.
        lifted : list of str
            Vehicles whose file had been revoked and is now allowed again.

        Raises
        ------
        ParameterError, RepositoryStateError
            If one is no parameter file, does not fit, or is a second one for its vehicle; then nothing is staged.
        """
        expires = (datetime.now(UTC) + timedelta(days=days)).replace(microsecond=0)
        bins: dict[str, dict[str, tuple[int, str, TargetFacts]]] = defaultdict(dict)
        for path in files:
            content = parameter_bytes(path)
            parameters = decode_parameters(content, str(path))
            if database is not None:
                try:
                    check_fit(parameters, database, None)
                except UnfitError as error:
                    raise RepositoryStateError(f"{path}: no vehicle will take it: {error}") from None
            target, digest = target_path(parameters.vehicle), sha256(content).hexdigest()
            added = bins[_BINS.get_role_for_target(target)]
            if target in added:
                raise RepositoryStateError(f"{path}: a second file for vehicle {parameters.vehicle}; add one of them")
            facts = TargetFacts(
                vehicle=parameters.vehicle,
                layout=parameters.layout.sha256,
                dbc=parameters.dbc.sha256,
                expires=expires,
                allow_large_step=allow_large_step,
            )
            _write(self._folder / "targets" / f"{digest}.{target}", content)
            added[target] = len(content), digest, facts
        lifted = []
        for role, added in bins.items():
            targets: Targets = self._latest(role) or Targets()
            for target, (length, digest, facts) in added.items():
                before = targets.targets.get(target)
                revoked = _facts(before).revoked if before else []
                if digest in revoked:
                    lifted.append(facts.vehicle)
                others = [item for item in revoked if item != digest]
                _set_target(targets, target, length, digest, replace(facts, revoked=others))
            self._stage(role, targets)
        return len(bins), lifted

    def revoke(self, vehicles: Sequence[str], digest: str | None) -> None:
        """Stage the revocation of one file per vehicle: its latest, or the one with this SHA-256 (hexadecimal).

        RepositoryStateError if a vehicle has no such file here, or it is revoked already; then nothing is staged.
        """
        bins: dict[str, Targets] = {}
        for vehicle in vehicles:
            path = target_path(vehicle)
            role = _BINS.get_role_for_target(path)
            targets = bins.get(role) or self._latest(role)
            if targets is None or path not in targets.targets:
                raise RepositoryStateError(f"{self._folder}: no parameters of vehicle {vehicle!r} here")
            file = targets.targets[path]
            facts, wanted = _facts(file), digest or file.hashes["sha256"]
            if wanted in facts.revoked:
                raise RepositoryStateError(f"{self._folder}: {wanted[:8]}... of vehicle {vehicle!r} is revoked already")
            if not (self._folder / "targets" / f"{wanted}.{path}").exists():
                raise RepositoryStateError(f"{self._folder}: vehicle {vehicle!r} never had a file {wanted[:8]}... here")
            revoked = sorted({*facts.revoked, wanted})
            _set_target(targets, path, file.length, file.hashes["sha256"], replace(facts, revoked=revoked))
            bins[role] = targets
        for role, targets in bins.items():
            self._stage(role, targets)

    def threshold(self, role: str) -> int:
        """Return how many keys of a role must sign."""
        return int(self._latest("root").roles[role].threshold)

    def rotate(self, role: str, new: NewKeys) -> None:
        """Stage a root in which a role has new keys; if the role is targets, also targets and all published bins.

        These must then be signed with the new keys.
        """
        root: Root = self._latest("root")
        for keyid in list(root.roles[role].keyids):
            root.revoke_key(keyid, role)
        _set_keys(root, role, new)
        self._stage("root", root)
        if role == "targets":
            targets: Targets = self._latest("targets")
            _delegate(targets, new)
            self._stage("targets", targets)
            for name in self._versions:
                if name.startswith("bins-"):
                    self._stage(name, self._latest(name))

    def renew(self) -> None:
        """Stage anew the root, targets and bins that expire within ``_RENEW_DAYS``."""
        soon = datetime.now(UTC) + timedelta(days=_RENEW_DAYS)
        live = {"root": self._root_version, **self._versions}
        for role, version in live.items():
            if not (self._staged / f"{role}.json").exists() and self._live_expiry(f"{version}.{role}") < soon:
                self._stage(role, self._live(role))

    def unstage(self) -> list[str]:
        """Drop all staged metadata, and return its roles; raise RepositoryStateError before the first publication."""
        if not self._timestamp_version:
            raise RepositoryStateError(f"{self._folder}: nothing was published yet; remove the folder to begin anew")
        paths = sorted(self._staged.glob("*.json"))
        for path in paths:
            path.unlink()
        return [path.stem for path in paths]

    @property
    def valid_until(self) -> datetime | None:
        """When vehicles stop accepting the published metadata, unless it is renewed; None before the first publication.

        It is the earliest expiry of timestamp, root and targets. Each publication renews timestamp and snapshot; root
        and targets may expire while their next version still lacks signatures.
        """
        if not self._timestamp_version:
            return None
        names = ["timestamp", f"{self._root_version}.root", f"{self._versions['targets']}.targets"]
        return min(map(self._live_expiry, names))

    def _live_expiry(self, name: str) -> datetime:
        path = self._metadata / f"{name}.json"
        with _readable(path):
            return expiry_of(path.read_bytes())

    def sign(self, signers: Sequence[Signer]) -> Iterator[str]:
        """Sign all staged metadata, one role per iteration; :attr:`waiting` then names those that lack signatures.

        Parameters
        ----------
        signers : sequence of Signer
            Keys of any roles; each signs only the metadata of its roles.

        Yields
        ------
        str
            Name of the staged role that was signed or checked.

        Raises
        ------
        RepositoryStateError
            If a key belongs to no role, or metadata cannot be read or written.
        """
        root, targets, live = self._latest("root"), self._latest("targets"), self._live("root")
        known = {*root.keys, *(live.keys if live else ()), *(targets.delegations.keys if targets.delegations else ())}
        for signer in signers:
            if signer.public_key.keyid not in known:
                raise RepositoryStateError(f"{self._folder}: key {signer.public_key.keyid[:8]} belongs to no role here")
        for role in sorted(path.stem for path in self._staged.glob("*.json")):
            path = self._staged / f"{role}.json"
            metadata = self._read(path)
            self._staged_versions[role] = metadata.signed.version
            delegators: list[Root | Targets] = [targets] if role.startswith("bins-") else [root]
            if role == "root" and live is not None:
                delegators.append(live)
            before = len(metadata.signatures)
            for signer in signers:
                if any(signer.public_key.keyid in each.get_delegated_role(role).keyids for each in delegators):
                    metadata.sign(signer, append=True)
            if len(metadata.signatures) > before:
                _write(path, _encoded(metadata))
            for delegator in delegators:
                found = delegator.get_verification_result(role, metadata.signed_bytes, metadata.signatures)
                if not found.verified:
                    self.waiting[role] = _lacking(len(found.signed), found.threshold, found.unsigned)
            yield role

    @property
    def missing(self) -> dict[str, str]:
        """Signatures that what is staged still needs to be published, by role; call :meth:`sign` before.

        Snapshot and timestamp are among them, as they are signed only when everything else is.
        """
        return self.waiting | _missing_online(self._latest("root"), []) if self._staged_versions else {}

    def publish(self, signers: Sequence[Signer]) -> None:
        """Publish what is staged; if some of it still lacks signatures, publish only a new snapshot and timestamp.

        Parameters
        ----------
        signers : sequence of Signer
            Keys of snapshot and timestamp.

        Raises
        ------
        RepositoryStateError
            If some of these keys are missing, or nothing can be published yet; vehicles then see what they saw before.
        """
        root = self._live("root") if self.waiting else self._latest("root")
        missing = self.waiting | _missing_online(root or self._latest("root"), signers)
        if root is None or not missing.keys() <= self.waiting.keys():
            raise RepositoryStateError(
                f"{self._folder}: not published: {missing_text(missing)}; publish again with --key of those who have "
                f"not signed (what was signed is kept)"
            )
        self._put_in_place(root, {} if self.waiting else self._staged_versions, signers)

    def _put_in_place(self, root: Root, staged: Mapping[str, int], signers: Sequence[Signer]) -> None:
        """Publish what is staged, timestamp last: until then vehicles see at most a new root, and a rerun continues."""
        for role, version in staged.items():
            content = (self._staged / f"{role}.json").read_bytes()
            _write(self._metadata / f"{version}.{role}.json", content)
            if role != "root":
                self._versions[role] = version
        snapshot = Snapshot(
            version=self._snapshot_version + 1,
            expires=_expiry("snapshot"),
            meta={f"{role}.json": MetaFile(version) for role, version in self._versions.items()},
        )
        content = _signed_by(root, "snapshot", snapshot, signers)
        write_files({self._metadata / f"{snapshot.version}.snapshot.json": content})
        timestamp = Timestamp(
            version=self._timestamp_version + 1,
            expires=_expiry("timestamp"),
            snapshot_meta=MetaFile.from_data(snapshot.version, content, ["sha256"]),
        )
        os.sync()
        write_files({self._metadata / "timestamp.json": _signed_by(root, "timestamp", timestamp, signers)})
        for role, version in {**staged, "snapshot": snapshot.version}.items():
            (self._staged / f"{role}.json").unlink(missing_ok=True)
            if role != "root":  # keep the version before, as vehicles may be reading it
                (self._metadata / f"{version - 2}.{role}.json").unlink(missing_ok=True)

    def bundle(self, vehicle: str) -> bytes:
        """Return the content of one file with all that a vehicle needs to update from any earlier version.

        RepositoryStateError if its parameters are not published, the metadata has expired, or files are damaged.
        """
        path, until = target_path(vehicle), self.valid_until
        if until is not None and until <= datetime.now(UTC):
            raise RepositoryStateError(
                f"{self._folder}: no vehicle takes it since {until:%Y-%m-%d}, when its metadata expired; publish first"
            )
        role = _BINS.get_role_for_target(path)
        targets = self._live(role)
        if targets is None or path not in targets.targets:
            raise RepositoryStateError(f"{self._folder}: no parameters of vehicle {vehicle!r} are published here")
        names = [f"metadata/{version}.root.json" for version in range(1, self._root_version + 1)]
        names += ["metadata/timestamp.json", f"metadata/{self._snapshot_version}.snapshot.json"]
        names += [f"metadata/{self._versions[name]}.{name}.json" for name in ("targets", role)]
        names.append(f"targets/{targets.targets[path].hashes['sha256']}.{path}")
        try:
            return bundle_bytes({name: (self._folder / name).read_bytes() for name in names})
        except OSError as error:
            raise RepositoryStateError(f"{error.filename}: cannot be read: {error.strerror}") from None
        except UnicodeDecodeError:
            raise RepositoryStateError(
                f"{self._folder}: a root or the parameters of vehicle {vehicle!r} are damaged; take a copy of the "
                f"repository"
            ) from None


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (RepositoryError, OSError, ValueError) as error:
        raise RepositoryStateError(
            f"{path}: cannot be read as metadata: {error}; take a copy of the repository"
        ) from None


def missing_text(missing: Mapping[str, str]) -> str:
    """Join what roles lack, ``{"root": "1 of 2 signatures ..."}``, into one text that names four roles at most."""
    words = [f"{role} has {what}" for role, what in [*missing.items()][:_SHOWN]]
    return "; ".join(words) + (f"; and {counted(len(missing) - _SHOWN, 'more role')}" if len(missing) > _SHOWN else "")


def _missing_online(root: Root, signers: Sequence[Signer]) -> dict[str, str]:
    """Return which signatures snapshot and timestamp would lack if only `signers` signed them."""
    missing = {}
    for role in ("snapshot", "timestamp"):
        wanted = root.roles[role]
        given = {signer.public_key.keyid for signer in signers} & set(wanted.keyids)
        if len(given) < wanted.threshold:
            missing[role] = _lacking(len(given), wanted.threshold, set(wanted.keyids) - given)
    return missing


def _lacking(signed: int, threshold: int, others: Iterable[str]) -> str:
    return f"{signed} of {threshold} signatures, not of {', '.join(sorted(keyid[:8] for keyid in others))}"


def _write(path: Path, content: bytes) -> None:
    """Replace a file in one step; it is surely on the disk only after the sync that publishing does."""
    new = path.with_suffix(".new")
    try:
        new.write_bytes(content)
        new.replace(path)
    except OSError as error:
        raise RepositoryStateError(f"{path}: cannot be written: {error.strerror}") from None


def _set_keys(root: Root, role: str, new: NewKeys) -> None:
    for key in new.keys:
        root.add_key(key, role)
    root.roles[role].threshold = new.threshold


def _delegate(targets: Targets, new: NewKeys) -> None:
    """Let the keys of targets also sign the bins."""
    keys: dict[str, Key] = {key.keyid: key for key in new.keys}
    targets.delegations = Delegations(keys, succinct_roles=SuccinctRoles(list(keys), new.threshold, BIN_BITS, "bins"))


def _facts(file: TargetFile) -> TargetFacts:
    return msgspec.convert(file.custom, TargetFacts)


def _set_target(targets: Targets, path: str, length: int, digest: str, facts: TargetFacts) -> None:
    custom = msgspec.to_builtins(facts)
    targets.targets[path] = TargetFile(length, {"sha256": digest}, path, {"custom": custom})


def _signed_by(root: Root, role: str, signed: Signed, signers: Sequence[Signer]) -> bytes:
    metadata = Metadata[Any](signed)
    for signer in signers:
        if signer.public_key.keyid in root.roles[role].keyids:
            metadata.sign(signer, append=True)
    return _encoded(metadata)


def _encoded(metadata: Metadata[Any]) -> bytes:
    return metadata.to_bytes(JSONSerializer(compact=True))
