"""Files that a user names: read if they are regular and not too large, written whole, and what is wrong in them.

msgspec decides whether a document has the structure that it should have; :func:`field_error` says why not in the words
of the file's author.
"""

import codecs
import difflib
import errno
import hashlib
import json
import os
import re
import stat
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec

__all__ = [
    "UnsuitableFileError",
    "field_error",
    "json_error",
    "read_user_file",
    "repeated_key",
    "text_digest",
    "write_atomically",
]


class UnsuitableFileError(OSError):
    """What a name leads to is no regular file, or too large; its text is to stand behind that name."""

    def __str__(self) -> str:
        return str(self.strerror)


_KINDS = {"d": "a folder", "p": "a pipe", "s": "a socket", "c": "a device", "b": "a device"}
"""Files that are not regular, by the letter with which ``ls -l`` shows them."""


def read_user_file(path: Path, *, largest_bytes: int) -> bytes:
    """Read a file; what is no regular one is not opened: a pipe would keep the reader waiting, a device never ends.

    Parameters
    ----------
    path : Path
        As the user wrote it.
    largest_bytes : int
        Size that is still accepted. [byte]

    Returns
    -------
    bytes
        Its content.

    Raises
    ------
    OSError
        If there is no such file, or it cannot be read; :class:`UnsuitableFileError` if it is something else, or larger.
    """
    _require_regular(path.stat())
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        _require_regular(os.fstat(file.fileno()))  # the folder's owner may have put another one there
        content = file.read(largest_bytes + 1)
    if len(content) > largest_bytes:
        raise UnsuitableFileError(errno.EFBIG, f"it is larger than {largest_bytes} bytes, which no such file is")
    return content


def _require_regular(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.filemode(found.st_mode)[0], "no regular file")
        raise UnsuitableFileError(errno.EINVAL, f"it is {kind}; a file is expected")


def text_digest(content: bytes) -> str:
    """SHA-256 of a text, the same for LF and CRLF line ends."""
    return hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file by new content; after a power cut either the old or the new one stands there."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def field_error(error: Exception, document: Any, schema: Any) -> tuple[list[str], str]:
    """Say what is wrong with a document that does not have the structure that it should have.

    Parameters
    ----------
    error : Exception
        With which msgspec refused it; its text is used where no field is found to be wrong.
    document : object
        The document as plain dicts, lists, texts and numbers.
    schema : type
        What it should be, a structure of msgspec.

    Returns
    -------
    list of str
        Where: keys, and names or numbers of entries of lists, such as ``branch``, ``'heater'``, ``timeout_s``.
    str
        What, such as ``a number is expected, found "x"``.
    """
    return _problem(document, schema) or ([], str(error))


def _problem(value: Any, kind: Any) -> tuple[list[str], str] | None:
    """Find the innermost part of a value that msgspec refuses; return where it is and what is wrong, or None."""
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        why = str(error).partition(" - at `")[0]
    else:
        return None
    kinds = list(_alternatives(kind))
    tagged = [config for bare, _ in kinds if (config := getattr(bare, "__struct_config__", None)) and config.tag_field]
    if tagged and isinstance(value, Mapping) and not any(_is_meant(value, bare) for bare, _ in kinds):
        key, tags = tagged[0].tag_field, ", ".join(config.tag for config in tagged)
        found = f"found {value[key]!r}" if key in value else "it is missing"
        return [key], f"one of {tags} is expected, {found}"
    for bare, _ in kinds:
        for step, part, kind_of_part in _parts(value, bare):
            if (inner := _problem(part, kind_of_part)) is not None:
                return [step, *inner[0]], inner[1]
    return [], _in_words(why, value, kinds)


def _alternatives(kind: Any, limits: tuple[msgspec.Meta, ...] = ()) -> Iterator[tuple[Any, tuple[msgspec.Meta, ...]]]:
    """What a value of some kind may be, each with its limits."""
    if get_origin(kind) is Annotated:
        yield from _alternatives(kind.__origin__, (*limits, *kind.__metadata__))
    elif get_origin(kind) in {Union, UnionType}:
        for one in get_args(kind):
            yield from _alternatives(one, limits)
    else:
        yield kind, limits


def _parts(value: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """Parts of a table or list: what each is called, what it is, and of which kind it should be."""
    if get_origin(kind) is list and isinstance(value, list):
        for number, part in enumerate(value, start=1):
            name = part.get("name") if isinstance(part, Mapping) else None
            yield repr(name) if isinstance(name, str) else f"entry number {number}", part, get_args(kind)[0]
    elif get_origin(kind) is dict and isinstance(value, Mapping):
        for key, part in value.items():
            yield key, part, get_args(kind)[1]
    elif _is_meant(value, kind):
        for field in msgspec.structs.fields(kind):
            if field.encode_name in value:
                yield field.encode_name, value[field.encode_name], field.type


def _is_meant(value: Any, kind: Any) -> bool:
    """Whether a value is a table that is to be this structure: it has its tag, if structures are told apart by one."""
    if not (isinstance(kind, type) and issubclass(kind, msgspec.Struct) and isinstance(value, Mapping)):
        return False
    config = kind.__struct_config__
    return config.tag_field is None or value.get(config.tag_field) == config.tag


_WORDS = {
    "object": "a table",
    "array": "a list",
    "str": "a text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
}
"""What msgspec calls the kinds of values, for authors of files."""


def _in_words(why: str, value: Any, kinds: list[tuple[Any, tuple[msgspec.Meta, ...]]]) -> str:
    """What msgspec says of a value, and what it does not say: names, choices and what a pattern means."""
    if missing := re.fullmatch("Object missing required field `(.*)`", why):
        return f"'{missing[1]}' is missing"
    if unknown := re.fullmatch("Object contains unknown field `(.*)`", why, re.DOTALL):
        (struct,) = (kind for kind, _ in kinds if _is_meant(value, kind))
        tag = struct.__struct_config__.tag_field
        known = [*([tag] if tag else []), *(field.encode_name for field in msgspec.structs.fields(struct))]
        near = difflib.get_close_matches(unknown[1], known, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        return f"unknown key {unknown[1]!r}; {hint}allowed are {', '.join(known)}"
    expected = why.removeprefix("Expected ").partition(", got")[0]
    if choices := [repr(one) for kind, _ in kinds if get_origin(kind) is Literal for one in get_args(kind)]:
        expected = " or ".join(choices)
    elif " matching regex " in why:
        expected = next(meta.description for _, limits in kinds for meta in limits if meta.pattern and meta.description)
    else:
        for name, words in _WORDS.items():
            expected = re.sub(rf"\b{name}\b", words, expected)
        expected = expected.replace("`", "").replace(" | ", " or ")
    return f"{expected} is expected, found {_shown(value)}"


_LONGEST_VALUE = 40
"""Characters of a value that are shown."""


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = json.dumps(value, default=str)
    if len(text) <= _LONGEST_VALUE:
        return text
    return f"{text[:_LONGEST_VALUE]}..." + (f" ({len(value)} characters)" if isinstance(value, str) else "")


def json_error(error: Exception, content: bytes) -> str:
    """Say why a text is no JSON; other errors of its decoding in the words that they have."""
    if not content.strip():
        return "it is empty"
    if content.startswith(codecs.BOM_UTF8):
        return "it begins with a byte order mark (BOM); save it as UTF-8 without one"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return "it is no text in UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)


def repeated_key(content: bytes) -> str | None:
    """Find a key that stands twice in one object of sound JSON; None if there is none."""
    repeated: list[str] = []

    def collect(pairs: list[tuple[str, Any]]) -> None:
        repeated.extend(key for key, times in Counter(key for key, _ in pairs).items() if times > 1)

    json.loads(content, object_pairs_hook=collect, parse_float=str, parse_int=str)
    return repeated[0] if repeated else None
