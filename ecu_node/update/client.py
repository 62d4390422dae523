"""The update of a vehicle: TUF's client verifies what the repository offers, then our own checks follow.

TUF checks signatures, thresholds, versions, expiry and digests. Our checks are about the parameter set: vehicle,
layout, DBC, limits, largest step from the set in force, expiry of the set. A set that passes goes on trial
(:mod:`ecu_node.update.trial`) in the running node. Metadata that TUF has verified is kept, and revocations take effect,
even if our own checks then refuse the set; whatever TUF refuses leaves the state as it was.
"""

import os
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from urllib.parse import quote

import msgspec
import tuf.api.serialization.json as tuf_json
from msgspec.structs import replace
from securesystemslib.formats import encode_canonical
from tuf.api import exceptions
from tuf.api.metadata import Metadata, Root
from tuf.ngclient import Updater, UpdaterConfig
from urllib3.exceptions import HTTPError

from ecu_node.core.status import Reason, TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.documents import read_user_file
from ecu_node.errors import UserError
from ecu_node.parameters import MAX_FILE_BYTES, BranchParameters, VehicleParameters, check_fit, decode_parameters
from ecu_node.update.sources import open_source
from ecu_node.update.state import (
    ParameterSet,
    VehicleState,
    add_decision,
    locked,
    read_state,
    require_not_expired,
    state_path,
    time_text,
    write_state,
)

__all__ = ["TargetFacts", "expiry_of", "provision", "target_path", "update"]

_CONFIG = UpdaterConfig(max_delegations=4, targets_max_length=2_000_000)
"""Limits of TUF's client; its other limits are its defaults: 16 kB for a timestamp, 500 kB for a root, 2 MB for a
snapshot."""
_LARGEST_ROOT_BYTES = 512_000
_WORK = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108
"""Folder in which TUF's client works: in memory if there is such a folder, which saves time and flash wear."""
_ROLES = ("root", "timestamp", "snapshot")
"""Metadata that a client keeps, against replays."""
_FOREIGN = (
    "another repository than the one that this vehicle trusts, or it was changed on the way; "
    "all N.root.json belong to it"
)
_Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


def _canonical_json(document: Any) -> str | None:
    """Encode a signed document as canonical JSON, by msgspec where the result is the same: if nothing is escaped.

    securesystemslib encodes in Python, and python-tuf lets it do so twice for each file: for the snapshot of 10^6
    vehicles that took two thirds of the time of an update. It refuses numbers that are not finite, which msgspec writes
    as null, so documents with a null are left to securesystemslib, too.
    """
    text = msgspec.json.encode(document, order="sorted").decode()
    return encode_canonical(document) if "\\" in text or "null" in text else text


tuf_json.encode_canonical = _canonical_json  # type: ignore[assignment]  # called with one argument


class TargetFacts(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What is signed about a parameter file besides its digest: the custom fields of its entry in TUF's metadata."""

    vehicle: str
    layout: _Digest
    dbc: _Digest
    expires: Annotated[datetime, msgspec.Meta(tz=True)]
    allow_large_step: bool = False
    revoked: Annotated[list[_Digest], msgspec.Meta(description="SHA-256 of files that must not be used any more")] = []


class _Signed(msgspec.Struct):
    expires: datetime


class _Metadata(msgspec.Struct):
    """As much of TUF's metadata as :func:`expiry_of` needs."""

    signed: _Signed


class _Offer(msgspec.Struct, frozen=True):
    """What the repository offers to this vehicle, verified by TUF."""

    trusted: dict[str, str]
    facts: TargetFacts
    content: bytes
    sha256: str


def target_path(vehicle: str) -> str:
    """Return the path of a vehicle's parameter file in the repository, such as ``V001.json``; never outside it."""
    return f"{quote(vehicle, safe='', errors='surrogateescape')}.json"


def expiry_of(metadata: bytes) -> datetime:
    """Return the expiry of metadata; nothing else is decoded, as metadata may be large."""
    return msgspec.json.decode(metadata, type=_Metadata).signed.expires


def provision(folder: Path, vehicle: str, root: Path, now: datetime) -> int:
    """Create the state folder of a vehicle, which says which repository it trusts.

    Parameters
    ----------
    folder : Path
        State folder of the vehicle; made if it does not exist.
    vehicle : str
        Identity of the vehicle.
    root : Path
        Root metadata of the repository, such as ``metadata/1.root.json``; it is trusted as it is.
    now : datetime
        Time of day, for the log.

    Returns
    -------
    int
        Version of the root.

    Raises
    ------
    UserError
        If the file is not a root signed by its own keys, a state exists already, or it cannot be written.
    """
    try:
        content = read_user_file(root, largest_bytes=_LARGEST_ROOT_BYTES)
        metadata, text = Metadata[Any].from_bytes(content), content.decode()
        if not isinstance(metadata.signed, Root):
            raise ValueError("metadata of another role")
        metadata.signed.verify_delegate("root", metadata.signed_bytes, metadata.signatures)
    except OSError as error:
        raise UserError(f"{root}: cannot read the root: {error.strerror}") from None
    except (exceptions.RepositoryError, ValueError):
        raise UserError(f"{root}: 1.root.json of 'calibrator repository init' is expected") from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}; choose another --state") from None
    with locked(folder):
        if state_path(folder).exists():
            raise UserError(f"{folder}: there is a state already; a new root comes with 'ecu-node update'")
        write_state(folder, VehicleState(vehicle=vehicle, root=text, latest=now))
        add_decision(folder, "provisioned", f"vehicle {vehicle} trusts root {metadata.signed.version}", now)
    return metadata.signed.version


def update(folder: Path, source: str, database: VehicleDatabase, now: datetime, *, dry_run: bool = False) -> str:
    """Take what a repository offers to this vehicle: a set goes on trial, a revocation takes effect at once.

    Parameters
    ----------
    folder : Path
        State folder of the vehicle.
    source : str
        Bundle, folder or URL.
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    now : datetime
        Present date and time, with time zone.
    dry_run : bool
        Check everything, change nothing.

    Returns
    -------
    str
        The outcome, in one line.

    Raises
    ------
    UnfitError
        If there is no state that can be read, or the offer is refused; with the reason. Revocations that came with a
        refused offer take effect all the same, but in a dry run.
    UserError
        If another process holds the lock, or the state cannot be written.
    """
    with nullcontext() if dry_run else locked(folder):
        before = state = read_state(folder)
        refusal: UnfitError | None = None
        told = ""
        try:
            offer = _verified_offer(before, source, max(now, before.latest))
            state, told = _without_revoked(before, offer, now)
            state, event, text = _judged(state, offer, source, database, now)
        except UnfitError as error:
            refusal, event, text = error, "refused", str(error)
        if not dry_run:
            if state != before:
                write_state(folder, state)
            if told:
                add_decision(folder, "revoked", told, now)
            if event != "nothing new":
                add_decision(folder, event, text, now, reason=refusal.reason if refusal else None)
        if refusal is not None:
            raise type(refusal)(refusal.reason, f"{text}; {told}" if told else text)
    return f"revoked: {told}; {event}: {text}" if told else f"{event}: {text}"


def _verified_offer(state: VehicleState, source: str, now: datetime) -> _Offer:
    """Run TUF's client workflow on a copy of the trusted metadata; raise TrustError if anything is refused."""
    fetcher = open_source(source)
    target = target_path(state.vehicle)
    with TemporaryDirectory(prefix="ecu-node-", dir=_WORK) as name:
        work = Path(name)
        for role, text in (("timestamp", state.timestamp), ("snapshot", state.snapshot)):
            if text is not None:
                (work / f"{role}.json").write_text(text)
        try:
            updater = Updater(name, "metadata", None, "targets", fetcher, _CONFIG, bootstrap=state.root.encode())
            try:
                info = updater.get_targetinfo(target)
            except exceptions.RepositoryError as error:  # only its text tells a bin that was never published
                if "delegated but is not part of snapshot" not in str(error):
                    raise
                info = None
            for path in work.glob("*.json"):
                _require_fresh(path, source, now)
            if info is None:
                raise TrustError(
                    Reason.NO_PARAMETERS,
                    f"{source}: nothing is published for vehicle {state.vehicle!r} yet; add and publish its parameters",
                )
            if info.length > MAX_FILE_BYTES or set(info.hashes) != {"sha256"}:
                raise TrustError(Reason.MALFORMED_PARAMETERS, f"{source}: {target} is no parameter file")
            content = Path(updater.download_target(info, str(work / "parameters"))).read_bytes()
            facts = msgspec.convert(info.custom, TargetFacts)
        except (exceptions.RepositoryError, exceptions.DownloadError, HTTPError) as error:
            raise _refusal(error, source, state.vehicle) from None
        except msgspec.ValidationError as error:
            raise TrustError(Reason.MALFORMED_PARAMETERS, f"{source}: custom fields of {target}: {error}") from None
        trusted = {role: (work / f"{role}.json").read_text() for role in _ROLES}
    return _Offer(trusted, facts, content, info.hashes["sha256"])


def _require_fresh(path: Path, source: str, now: datetime) -> None:
    """Raise TrustError if verified metadata has expired by the latest known time; TUF's client uses only the clock."""
    expires = expiry_of(path.read_bytes())
    if now >= expires:
        raise TrustError(
            Reason.NOT_VALID_NOW,
            f"{source}: {path.name} expired at {time_text(expires)}, and the latest time seen here is "
            f"{time_text(now)}; get a newer one",
        )


_REFUSALS: tuple[tuple[type[Exception], Reason, str], ...] = (
    (exceptions.ExpiredMetadataError, Reason.NOT_VALID_NOW, "get a newer one, or set the clock"),
    (exceptions.BadVersionNumberError, Reason.REPLAYED, "older than what was accepted before"),
    (exceptions.UnsignedMetadataError, Reason.NOT_SIGNED, _FOREIGN),
    (exceptions.LengthOrHashMismatchError, Reason.NOT_SIGNED, _FOREIGN),
    (exceptions.RepositoryError, Reason.MALFORMED_PARAMETERS, "copy it again"),
    (exceptions.DownloadLengthMismatchError, Reason.MALFORMED_PARAMETERS, "copy it again"),
    (exceptions.DownloadHTTPError, Reason.NO_PARAMETERS, "is it complete, and for vehicle {vehicle!r}, which this is?"),
    (Exception, Reason.NO_PARAMETERS, "check address and connection, or whether it can be read"),
)
"""Reason and advice for each error of TUF's client; the first class that matches counts."""


def _refusal(error: Exception, source: str, vehicle: str) -> TrustError:
    """Translate an error of TUF's client into one line with a reason."""
    reason, advice = next(found[1:] for found in _REFUSALS if isinstance(error, found[0]))
    is_of_web = source.startswith("http") and isinstance(error, exceptions.DownloadError | HTTPError)
    while is_of_web and error.__context__ is not None:  # the innermost error names the cause, such as an unknown host
        error = error.__context__  # type: ignore[assignment]
    return TrustError(reason, f"{source}: {str(error) or type(error).__name__}; {advice.format(vehicle=vehicle)}")


def _without_revoked(state: VehicleState, offer: _Offer, now: datetime) -> tuple[VehicleState, str]:
    """Return the state with the verified metadata and without revoked sets, and in words what was revoked.

    Raise TrustError if the offer is for another vehicle.
    """
    if offer.facts.vehicle != state.vehicle:
        raise TrustError(
            Reason.WRONG_VEHICLE, f"the parameters are for {offer.facts.vehicle!r}, this is {state.vehicle!r}"
        )
    held = {name: getattr(state, name) for name in ("in_force", "on_trial", "before")}
    revoked = {name: found for name, found in held.items() if found and found.sha256 in offer.facts.revoked}
    kept = {name: None if name in revoked else found for name, found in held.items()}
    state = replace(state, latest=max(now, state.latest), **offer.trusted, **kept)
    if "in_force" in revoked:
        state = replace(state, in_force=state.before, before=None, ended="revoked")
    elif revoked and state.in_force is None:
        state = replace(state, ended="revoked")
    names = list(dict.fromkeys(map(str, revoked.values())))
    now_in_force = f"{state.in_force} is in force now" if state.in_force else "nothing is in force now"
    return state, f"{', '.join(names)}; {now_in_force}" if names else ""


def _judged(
    state: VehicleState, offer: _Offer, source: str, database: VehicleDatabase, now: datetime
) -> tuple[VehicleState, str, str]:
    """Decide on the set that is offered; return the new state, the event, such as "on trial", and a text about it."""
    if offer.sha256 in offer.facts.revoked:
        return state, "nothing new", f"what the repository has for vehicle {state.vehicle} is revoked"
    try:
        parameters = decode_parameters(offer.content, source)
        found = ParameterSet(content=offer.content.decode(), expires=offer.facts.expires)
        if (parameters.layout.sha256, parameters.dbc.sha256) != (offer.facts.layout, offer.facts.dbc):
            raise TrustError(
                Reason.MALFORMED_PARAMETERS, f"{source}: layout and DBC are not those of the signed description"
            )
        require_not_expired(found, state, now)
        check_fit(parameters, database, state.vehicle)
        if state.in_force == found:
            return replace(state, on_trial=None), "nothing new", f"{found} is in force"
        if state.on_trial == found:
            return state, "nothing new", f"{found} is on trial"
        if state.failed == found:
            raise TrustError(Reason.REPLAYED, f"{source}: {found} has failed its trial here; calibrate anew")
        if state.in_force is not None and state.in_force.content == found.content:
            until = time_text(found.expires)
            return replace(state, in_force=found, on_trial=None), "extended", f"{found} is in force until {until}"
        if not offer.facts.allow_large_step and state.in_force is not None:
            _require_small_step(state.in_force.parameters, parameters, database)
    except UnfitError as error:
        text = str(error)
        raise type(error)(error.reason, text if text.startswith(source) else f"{source}: {text}") from None
    return replace(state, on_trial=found), "on trial", str(found)


def _require_small_step(before: VehicleParameters, new: VehicleParameters, database: VehicleDatabase) -> None:
    """Raise TrustError if parameters differ from those in force by more than the layout's largest step."""

    def applied(branch: BranchParameters | None) -> tuple[float, float]:
        return (branch.drift, branch.offset_a) if branch is not None and branch.apply else (0.0, 0.0)

    layout = database.layout
    for name in layout.branch_names:
        (old_drift, old_a), (new_drift, new_a) = (applied(item.branches.get(name)) for item in (before, new))
        drift, offset_a = abs(old_drift - new_drift), abs(old_a - new_a)
        if drift > layout.activation.step_drift or offset_a > layout.step_offset_a:
            raise TrustError(
                Reason.IMPLAUSIBLE_PARAMETERS,
                f"branch {name}: differs from the set in force by {drift:.3g} in drift and {offset_a:.3g} A in offset, "
                f"at most {layout.activation.step_drift:g} and {layout.step_offset_a:g} A are allowed; if that is "
                f"meant, add it with --allow-large-step",
            )
