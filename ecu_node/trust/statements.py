"""What is signed: parameters of a vehicle with their place in time and order, and the revocation of some.

Each vehicle has one row of numbers: every statement for it has a higher one than all that it accepted before.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Literal

import msgspec

from ecu_node.core.status import Reason, TrustError
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.canonical import read_canonical
from ecu_node.trust.envelope import Envelope, not_signed, read_envelope, require_known, signers, signers_among
from ecu_node.trust.key_set import KEYS_TYPE, KeySet, check_key_set

__all__ = [
    "KEYS_TYPE",
    "LAST_SEQUENCE",
    "MAX_SEQUENCE",
    "PARAMETERS_TYPE",
    "REVOCATION_TYPE",
    "Revocation",
    "SignedParameters",
    "Statement",
    "Verified",
    "open_statement",
    "verify",
]

PARAMETERS_TYPE = "application/vnd.hv-current-correction.parameters+json"
REVOCATION_TYPE = "application/vnd.hv-current-correction.revocation+json"

MAX_SEQUENCE = 1 << 52
"""Highest number of parameters. What is above is kept for revocations, so that any set can be taken back."""
LAST_SEQUENCE = (1 << 53) - 1
"""Highest number that canonical JSON can say."""

_Sequence = Annotated[int, msgspec.Meta(ge=1, le=LAST_SEQUENCE, description="above that of all statements before")]
_Time = Annotated[
    str, msgspec.Meta(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z\Z", description="ISO 8601, UTC")
]
_Vehicle = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class SignedParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of one vehicle, and for when they hold."""

    schema_version: Literal[1] = 1
    sequence: _Sequence
    not_before: _Time
    expires: _Time
    allow_large_step: Annotated[
        bool, msgspec.Meta(description="true: may differ from the set before by more than the layout's largest step")
    ] = False
    parameters: VehicleParameters

    @property
    def vehicle(self) -> str:
        """Whose they are."""
        return self.parameters.vehicle


class Revocation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of one vehicle that must not be used any more."""

    schema_version: Literal[1] = 1
    vehicle: _Vehicle
    sequence: _Sequence
    created: _Time
    revokes: Annotated[
        list[_Sequence], msgspec.Meta(min_length=1, max_length=64, description="sequence numbers of what is revoked")
    ]
    why: Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


Statement = SignedParameters | Revocation | KeySet
"""Any of them."""

_KINDS: dict[str, type[Statement]] = {
    PARAMETERS_TYPE: SignedParameters,
    REVOCATION_TYPE: Revocation,
    KEYS_TYPE: KeySet,
}


@dataclass(frozen=True, kw_only=True)
class Verified:
    """A statement that enough trusted signers vouch for."""

    statement: Statement
    signers: list[str]


def open_statement(content: bytes, where: str) -> tuple[Envelope, Statement]:
    """Read a signed file without asking whose it is, as to show it.

    Parameters
    ----------
    content : bytes
        Text of the file.
    where : str
        Where it is from, for messages.

    Returns
    -------
    Envelope, Statement
        What it says.

    Raises
    ------
    TrustError
        With reason MALFORMED_PARAMETERS if it is no signed file, or of no known kind.
    """
    envelope = read_envelope(content, where)
    return envelope, _statement(envelope, where)


def _statement(envelope: Envelope, where: str) -> Statement:
    kind = _KINDS.get(envelope.payloadType)
    if kind is None:
        raise TrustError(
            Reason.MALFORMED_PARAMETERS,
            f"{where}: a statement of kind {envelope.payloadType!r}; this version knows {', '.join(_KINDS)}",
        )
    statement = read_canonical(envelope.content, kind, f"{where}, signed content")
    if isinstance(statement, KeySet):
        check_key_set(statement, where)
    elif isinstance(statement, SignedParameters):
        instant(statement.not_before, where)
        instant(statement.expires, where)
    else:
        instant(statement.created, where)
    return statement


def verify(content: bytes, keys: KeySet, where: str) -> Verified:
    """Read a signed file that must be vouched for.

    A key set must be signed by enough signers of the set that is trusted, and by enough of its own: one whose keys
    nobody has would keep the vehicle from ever taking anything again. Its own are asked only after the others.

    Parameters
    ----------
    content : bytes
        Text of the file.
    keys : KeySet
        Whom to trust.
    where : str
        Where it is from, for messages.

    Returns
    -------
    Verified
        The statement and its signers.

    Raises
    ------
    TrustError
        As :func:`open_statement`, or with reason NOT_SIGNED.
    """
    envelope = read_envelope(content, where)
    if envelope.payloadType == KEYS_TYPE:
        return _verified_keys(envelope, keys, where)
    names = signers(envelope, keys, where)
    return Verified(statement=_statement(envelope, where), signers=names)


def _verified_keys(envelope: Envelope, keys: KeySet, where: str) -> Verified:
    """A key set; its content is not looked at before enough of those who are trusted vouch for it."""
    names = signers_among(envelope, keys, where)
    new = _statement(envelope, where)
    assert isinstance(new, KeySet), "the kind says so"
    require_known(envelope, keys.keys | new.keys, where)
    own = sum(signature.keyid in new.keys for signature in envelope.signatures)
    if own < new.threshold:
        raise not_signed(
            where,
            f"signed by {own} of the new set itself; {new.threshold} are needed, who so show that they have their keys",
        )
    return Verified(statement=new, signers=sorted({*names, *signers_among(envelope, new, where)}))


def instant(text: str, where: str) -> datetime:
    """A time of a statement."""
    try:
        return datetime.strptime(text, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    except ValueError:
        raise TrustError(Reason.MALFORMED_PARAMETERS, f"{where}: {text} is no time") from None
