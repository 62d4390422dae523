"""Whom a vehicle trusts: the public keys of the signers, and how many of them a statement needs."""

from itertools import pairwise
from typing import Annotated, Literal

import msgspec

from ecu_node.core.status import Reason, TrustError
from ecu_node.trust.canonical import Expected

__all__ = [
    "KEYS_TYPE",
    "KEY_SET",
    "MAX_FIRST_VERSION",
    "SIGNER_NAME",
    "KeyId",
    "KeySet",
    "PublicKey",
    "check_key_set",
]

KEYS_TYPE = "application/vnd.hv-current-correction.keys+json"
KEY_SET = Expected(what="a key set", advice="make one with 'calibrator keys set'")
MAX_FIRST_VERSION = 500_000
"""Of the set that a vehicle begins with: others must be able to come after it."""
SIGNER_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"
"""It stands in messages and in names of files."""
KeyId = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
"""By which a signature names its key; which key that is, the key set alone says."""


class PublicKey(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of one signer."""

    name: Annotated[str, msgspec.Meta(pattern=SIGNER_NAME)]
    ed25519: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z", description="public key, RFC 8032")]


class KeySet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Signers that are trusted. A new set takes the place of an old one if enough signers of both vouch for it."""

    schema_version: Literal[1] = 1
    version: Annotated[int, msgspec.Meta(ge=1, le=1_000_000, description="one more than that of the set before")]
    threshold: Annotated[int, msgspec.Meta(ge=1, le=16)]
    keys: Annotated[dict[KeyId, PublicKey], msgspec.Meta(min_length=1, max_length=16)]


def check_key_set(keys: KeySet, where: str) -> KeySet:
    """Check what types cannot say.

    Parameters
    ----------
    keys : KeySet
        To be checked.
    where : str
        Where it is from, for messages.

    Returns
    -------
    KeySet
        The same.

    Raises
    ------
    TrustError
        If one key or name stands there twice, or the threshold cannot be reached.
    """
    values = [key.ed25519 for key in keys.keys.values()]
    if len(set(values)) < len(values):
        raise TrustError(Reason.NOT_SIGNED, f"{where}: a key stands there twice; each signer has one of their own")
    names = sorted(key.name for key in keys.keys.values())
    twice = next((name for name, after in pairwise(names) if name == after), None)
    if twice is not None:
        raise TrustError(
            Reason.NOT_SIGNED, f"{where}: {twice} stands there with two keys; each signer counts once, with one key"
        )
    if keys.threshold > len(values):
        raise TrustError(
            Reason.NOT_SIGNED,
            f"{where}: {keys.threshold} signers are needed, and {len(values)} keys are there; name more signers, or "
            f"need fewer",
        )
    return keys
