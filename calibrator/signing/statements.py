"""Making signed files: parameters, revocations, key sets."""

from collections.abc import Sequence

from securesystemslib.dsse import Envelope as DsseEnvelope
from securesystemslib.signer import Signer

from ecu_node.trust.canonical import canonical_bytes
from ecu_node.trust.envelope import Envelope, write_envelope
from ecu_node.trust.key_set import KeySet
from ecu_node.trust.statements import (
    KEYS_TYPE,
    PARAMETERS_TYPE,
    REVOCATION_TYPE,
    Revocation,
    SignedParameters,
    Statement,
)

__all__ = ["signed_anew", "signed_statement"]

_TYPES: dict[type[Statement], str] = {
    SignedParameters: PARAMETERS_TYPE,
    Revocation: REVOCATION_TYPE,
    KeySet: KEYS_TYPE,
}


def signed_statement(statement: Statement, signers: Sequence[Signer]) -> bytes:
    """Sign a statement.

    Parameters
    ----------
    statement : SignedParameters, Revocation or KeySet
        What is to be vouched for.
    signers : sequence of Signer
        Who does; any signer of securesystemslib with an Ed25519 key.

    Returns
    -------
    bytes
        Text of the signed file.
    """
    return _signed(_TYPES[type(statement)], canonical_bytes(statement), {}, signers)


def signed_anew(envelope: Envelope, signers: Sequence[Signer]) -> bytes:
    """Add signatures to a signed file.

    Parameters
    ----------
    envelope : Envelope
        As it is signed so far.
    signers : sequence of Signer
        Who adds theirs.

    Returns
    -------
    bytes
        Text of the signed file.
    """
    before = DsseEnvelope.from_dict(
        {
            "payload": envelope.payload,
            "payloadType": envelope.payloadType,
            "signatures": [{"keyid": item.keyid, "sig": item.sig} for item in envelope.signatures],
        }
    )
    there = {keyid: bytes.fromhex(signature.signature) for keyid, signature in before.signatures.items()}
    return _signed(envelope.payloadType, envelope.content, there, signers)


def _signed(kind: str, payload: bytes, there: dict[str, bytes], signers: Sequence[Signer]) -> bytes:
    envelope = DsseEnvelope(payload, kind, {})
    made = [envelope.sign(signer) for signer in signers]
    return write_envelope(kind, payload, there | {item.keyid: bytes.fromhex(item.signature) for item in made})
