"""Files of this project that nobody signed, where a signed one is expected: what they are, and what to do."""

from typing import Literal

import msgspec

__all__ = ["UNSIGNED", "UnsignedKind", "unsigned_kind"]

UnsignedKind = Literal["parameter file", "key set", "public key"]
UNSIGNED: dict[UnsignedKind, str] = {
    "parameter file": "nobody signed this parameter file; see 'calibrator sign'",
    "key set": "nobody signed this key set; the first one is for 'ecu-node provision', a later one is to be signed",
    "public key": "it is a public key, and says nothing; make a key set of it with 'calibrator keys set'",
}
"""What to say of them."""
_FIELDS: dict[UnsignedKind, set[str]] = {
    "parameter file": {"vehicle", "branches"},
    "key set": {"threshold", "keys"},
    "public key": {"keyid", "key"},
}


def unsigned_kind(content: bytes) -> UnsignedKind | None:
    """What a file is, by its fields; None if it is none of these."""
    try:
        found = msgspec.json.decode(content, type=dict[str, msgspec.Raw])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    return next((kind for kind, fields in _FIELDS.items() if fields <= found.keys()), None)
