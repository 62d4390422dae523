"""Signed bytes: a DSSE envelope with Ed25519 signatures of several signers.

What is signed is PAE(type, payload) = "DSSEv1" SP len(type) SP type SP len(payload) SP payload [1]_, so that a
statement of one kind is never taken for one of another. Every signature in a file must be right and of a known signer,
not only as many as the threshold asks for: no byte of a file that is accepted could be another one.

.. [1] Dead Simple Signing Envelope, protocol version 1.0.
"""

import base64
import binascii
from collections.abc import Container
from typing import Annotated

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from ecu_node.core.status import Reason, TrustError
from ecu_node.trust.canonical import canonical_bytes, malformed, printable, read_canonical
from ecu_node.trust.key_set import KeyId, KeySet, PublicKey
from ecu_node.trust.unsigned import UNSIGNED, unsigned_kind

__all__ = [
    "Envelope",
    "Signature",
    "not_signed",
    "pae",
    "read_envelope",
    "require_known",
    "signers",
    "signers_among",
    "write_envelope",
]

_BEGIN = b'{"payload":'
"""Of every envelope, as canonical JSON has one order."""
_Base64 = Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9+/]*={0,2}$")]


class Signature(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of one signer."""

    keyid: KeyId
    sig: _Base64


class Envelope(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A payload and who signed it; names of the fields are those of DSSE."""

    payload: _Base64
    payloadType: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]  # noqa: N815
    signatures: Annotated[list[Signature], msgspec.Meta(min_length=1, max_length=16)]

    @property
    def content(self) -> bytes:
        """What is signed."""
        return base64.b64decode(self.payload)


def pae(payload_type: str, payload: bytes) -> bytes:
    """Pre-authentication encoding of DSSE: the bytes over which the signatures are."""
    kind = payload_type.encode()
    return b"DSSEv1 %d %b %d %b" % (len(kind), kind, len(payload), payload)


def write_envelope(payload_type: str, payload: bytes, signatures: dict[str, bytes]) -> bytes:
    """Text of a signed file.

    Parameters
    ----------
    payload_type : str
        Kind of the statement.
    payload : bytes
        The statement.
    signatures : dict of str to bytes
        By the identity of the signer's key: 64 bytes.

    Returns
    -------
    bytes
        Canonical JSON, and the end of the line.
    """
    envelope = Envelope(
        payload=base64.b64encode(payload).decode(),
        payloadType=payload_type,
        signatures=[
            Signature(keyid=keyid, sig=base64.b64encode(signatures[keyid]).decode()) for keyid in sorted(signatures)
        ],
    )
    return canonical_bytes(envelope) + b"\n"


def read_envelope(content: bytes, where: str) -> Envelope:
    """Read a signed file; nothing is verified yet.

    Parameters
    ----------
    content : bytes
        Text of the file.
    where : str
        Where it is from, for messages.

    Returns
    -------
    Envelope
        Of which there is one text only.

    Raises
    ------
    TrustError
        With reason MALFORMED_PARAMETERS if it is not an envelope as :func:`write_envelope` writes it, NOT_SIGNED if it
        is a file of this project that nobody signed.
    """
    if content.startswith(_BEGIN) and not content.endswith(b"\n"):
        raise malformed(where, "its end is missing")
    try:
        envelope = read_canonical(content.removesuffix(b"\n"), Envelope, where)
    except TrustError:
        kind = unsigned_kind(content)
        if kind is None:
            raise
        raise not_signed(where, UNSIGNED[kind]) from None
    try:
        texts = [envelope.payload, *(signature.sig for signature in envelope.signatures)]
        if any(base64.b64encode(base64.b64decode(text, validate=True)).decode() != text for text in texts):
            raise malformed(where, "base64 with bits that mean nothing")
    except binascii.Error:
        raise malformed(where, "not base64") from None
    keyids = [signature.keyid for signature in envelope.signatures]
    if keyids != sorted(set(keyids)):
        raise malformed(where, "signatures are repeated or out of order")
    return envelope


def signers(envelope: Envelope, keys: KeySet, where: str) -> list[str]:
    """Who vouches for an envelope.

    Parameters
    ----------
    envelope : Envelope
        From :func:`read_envelope`.
    keys : KeySet
        Signers that are trusted, and how many of them it takes.
    where : str
        Where it is from, for messages.

    Returns
    -------
    list of str
        Names of the signers.

    Raises
    ------
    TrustError
        With reason NOT_SIGNED if a signature is wrong or of an unknown key, or there are fewer than the threshold.
    """
    require_known(envelope, keys.keys, where)
    return signers_among(envelope, keys, where)


def signers_among(envelope: Envelope, keys: KeySet, where: str) -> list[str]:
    """Who of a key set vouches for an envelope; signatures of other keys are not looked at.

    Parameters, values and errors are those of :func:`signers`, but for unknown keys: see :func:`require_known`.
    """
    signed = pae(envelope.payloadType, envelope.content)
    names = []
    for signature in envelope.signatures:
        key = keys.keys.get(signature.keyid)
        if key is None:
            continue
        if not _is_right(signature, key, signed):
            raise not_signed(where, f"the signature of {key.name} is wrong: the file was changed")
        names.append(key.name)
    names.sort()
    if len(names) < keys.threshold:
        by = ", ".join(names) or "nobody of them"
        raise not_signed(where, f"signed by {by}; {keys.threshold} signers are needed")
    return names


def require_known(envelope: Envelope, keys: Container[str], where: str) -> None:
    """Refuse, with reason NOT_SIGNED, an envelope with a signature of a key that is not among these."""
    for signature in envelope.signatures:
        if signature.keyid not in keys:
            raise not_signed(where, f"signed with key {printable(signature.keyid[:12])}, which is not trusted here")


def _is_right(signature: Signature, key: PublicKey, signed: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(bytes.fromhex(key.ed25519)).verify(base64.b64decode(signature.sig), signed)
    except (InvalidSignature, ValueError):
        return False
    return True


def not_signed(where: str, why: str) -> TrustError:
    """That not enough people vouch for a file."""
    return TrustError(Reason.NOT_SIGNED, f"{where}: {why}")
