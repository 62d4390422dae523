"""Canonical JSON (RFC 8785): one text for one value, so that whoever signs and whoever checks speak of the same bytes.

What is not canonical is refused, whatever it says: repeated keys, other spellings of a number, white space, and bytes
that a lenient reader would pass over leave no trace in the value, and so none after a signature.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import rfc8785

from ecu_node.core.status import Reason, TrustError
from ecu_node.documents import UnsuitableFileError, json_error, read_user_file
from ecu_node.errors import printable

__all__ = [
    "MAX_BYTES",
    "SIGNED_FILE",
    "Expected",
    "canonical_bytes",
    "malformed",
    "printable",
    "read_bytes",
    "read_canonical",
]

MAX_BYTES = 2_000_000
"""A signed file has some kilobytes; a larger one is not one."""

_LONGEST_WHY = 300
_Value = TypeVar("_Value")


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What a file is to be, and what to do if it is not, in words."""

    what: str
    advice: str


SIGNED_FILE = Expected(what="a signed file", advice="sign the parameters anew")


def canonical_bytes(value: Any) -> bytes:
    """The one text of a value.

    Parameters
    ----------
    value : Any
        Structs, dicts, lists, texts, finite numbers; integers within 2^53.

    Returns
    -------
    bytes
        RFC 8785.

    Raises
    ------
    TrustError
        If JSON cannot say it, such as a number that is not finite.
    """
    try:
        return rfc8785.dumps(msgspec.to_builtins(value))
    except (rfc8785.CanonicalizationError, ValueError) as error:
        raise TrustError(Reason.MALFORMED_PARAMETERS, f"cannot be said in canonical JSON: {error}") from None


def read_canonical(content: bytes, kind: type[_Value], where: str, expected: Expected = SIGNED_FILE) -> _Value:
    """Read canonical JSON of a known structure.

    Parameters
    ----------
    content : bytes
        The text.
    kind : type
        A msgspec structure.
    where : str
        Where it is from, for messages.
    expected : Expected
        What it is to be, for messages.

    Returns
    -------
    object of that type
        What it says.

    Raises
    ------
    TrustError
        If it is not JSON, not of that structure, or not canonical.
    """
    try:
        document = msgspec.json.decode(content)
        value = msgspec.convert(document, kind)
        same = rfc8785.dumps(document) == content
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError, RecursionError) as error:
        raise malformed(where, json_error(error, content), expected) from None
    except (rfc8785.CanonicalizationError, ValueError) as error:
        raise malformed(where, f"no canonical JSON says this: {error}", expected) from None
    if not same:
        raise malformed(where, "not canonical JSON (RFC 8785): it was changed, or written by something else", expected)
    return value


def read_bytes(path: Path, expected: Expected = SIGNED_FILE) -> bytes:
    """Content of a signed file.

    Parameters
    ----------
    path : Path
        A regular file.
    expected : Expected
        What it is to be, for messages.

    Returns
    -------
    bytes
        At most :data:`MAX_BYTES`.

    Raises
    ------
    TrustError
        With reason NO_PARAMETERS if it cannot be read, MALFORMED_PARAMETERS if it is too large.
    """
    try:
        return read_user_file(path, largest_bytes=MAX_BYTES)
    except UnsuitableFileError as error:
        raise malformed(str(path), str(error), expected) from None
    except OSError as error:
        why = f"{path}: cannot read the file: {error.strerror}; name one that is there"
        raise TrustError(Reason.NO_PARAMETERS, why) from None


def malformed(where: str, why: str, expected: Expected = SIGNED_FILE) -> TrustError:
    """That a file is none of ours, in one line of bearable length, whatever names the file itself gives to things."""
    shown = printable(why)
    if len(shown) > _LONGEST_WHY:
        shown = f"{shown[:_LONGEST_WHY]}..."
    return TrustError(Reason.MALFORMED_PARAMETERS, f"{where}: not {expected.what}: {shown}; {expected.advice}")
