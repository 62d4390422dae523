"""Reads files that a user names, if they are regular and not too large; replaces files whole; says where one is wrong.

msgspec decides whether a document has the right structure; :func:`field_error` says where it has not.
"""

import difflib
import errno
import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec


class UnsuitableFileError(OSError):
    """A path leads to no regular file, or to one too large; its text follows the path, as in "PATH: it is a folder"."""

    def __str__(self) -> str:
        return str(self.strerror)


_KINDS = {"d": "a folder", "p": "a pipe", "s": "a socket", "c": "a device", "b": "a device"}
"""Files that are not regular, by the letter with which ``ls -l`` shows them."""


def read_user_file(path: Path, *, largest_bytes: int) -> bytes:
    """Read a regular file; anything else is refused, as a pipe would keep the reader waiting and a device never ends.

    Parameters
    ----------
    path : Path
        As the user wrote it.
    largest_bytes : int
        Largest size that is accepted. [byte]

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
        _require_regular(os.fstat(file.fileno()))  # another one may have been put there meanwhile
        content = file.read(largest_bytes + 1)
    if len(content) > largest_bytes:
        raise UnsuitableFileError(errno.EFBIG, f"it is larger than {largest_bytes} bytes, which no such file is")
    return content


def _require_regular(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.filemode(found.st_mode)[0], "no regular file")
        raise UnsuitableFileError(errno.EINVAL, f"it is {kind}; a file is expected")


def signature(path: Path) -> tuple[int, int, int, int] | None:
    """Return modification and change time [ns], size [byte] and inode of a file; they tell whether it was changed.

    None if there is no such file.
    """
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino


def text_digest(content: bytes) -> str:
    """Return the SHA-256 of a text, the same for LF and CRLF line ends."""
    return hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file by new content; after a power cut the old or the new content is there. OSError if it fails."""
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
        Error with which msgspec refused it; its text is used if no field is found to be wrong.
    document : object
        The document as plain dicts, lists, texts and numbers.
    schema : type
        Structure of msgspec that it should have.

    Returns
    -------
    list of str
        Where it is wrong: keys, and names or numbers of list entries, such as ``branch``, ``'heater'``, ``timeout_s``.
    str
        What is wrong, in msgspec's words, or which key is missing or unknown; and what was found.
    """
    return _problem(document, schema) or ([], str(error))


def _problem(value: Any, kind: Any) -> tuple[list[str], str] | None:
    """Find the innermost part of a value that msgspec refuses; return where it is and what is wrong, or None."""
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        why = str(error).partition(" - at `")[0].replace("`", "")
    else:
        return None
    is_table = isinstance(value, dict)
    kinds, limits = _alternatives(kind)
    structs = [one for one in kinds if is_table and isinstance(one, type) and issubclass(one, msgspec.Struct)]
    if len(structs) > 1:  # the value of one key says which of them is meant
        key = str(structs[0].__struct_config__.tag_field)
        by_tag = {str(one.__struct_config__.tag): one for one in structs}
        if not isinstance(value.get(key), str) or value[key] not in by_tag:
            found = f"found {_shown(value[key])}" if key in value else "it is missing"
            return [key], f"expected one of {', '.join(by_tag)}, {found}"
        structs = [by_tag[value[key]]]
    for one in structs or kinds:
        for step, part, kind_of_part in _parts(value, one):
            if (inner := _problem(part, kind_of_part)) is not None:
                return [step, *inner[0]], inner[1]
    for struct in structs:
        tag, fields = struct.__struct_config__.tag_field, msgspec.structs.fields(struct)
        known = [*([tag] if tag else []), *(field.encode_name for field in fields)]
        if unknown := [key for key in value if key not in known]:
            near = difflib.get_close_matches(unknown[0], known, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            return [], f"unknown key {unknown[0]!r}; {hint}allowed are {', '.join(known)}"
        if missing := [field.encode_name for field in fields if field.required and field.encode_name not in value]:
            return [], f"'{missing[0]}' is missing"
    expected = why
    if choices := [repr(choice) for one in kinds if get_origin(one) is Literal for choice in get_args(one)]:
        expected = f"expected {' or '.join(choices)}"
    elif isinstance(value, str) and (described := [meta.description for meta in limits if meta.pattern]):
        expected = f"expected {described[0]}"
    return [], f"{expected}, found {_shown(value)}"


def _alternatives(kind: Any) -> tuple[list[Any], list[msgspec.Meta]]:
    """Return the types that a value of this type may have, and the limits that are set for it."""
    if get_origin(kind) is Annotated:
        kinds, limits = _alternatives(kind.__origin__)
        return kinds, [*limits, *kind.__metadata__]
    if get_origin(kind) in {Union, UnionType}:
        each = [_alternatives(one) for one in get_args(kind)]
        return [one for kinds, _ in each for one in kinds], [meta for _, limits in each for meta in limits]
    return [kind], []


def _parts(value: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the parts of a table or list: the name of each, its value, and the type that it should have."""
    if get_origin(kind) is list and isinstance(value, list):
        for number, part in enumerate(value, start=1):
            name = part.get("name") if isinstance(part, dict) else None
            yield repr(name) if isinstance(name, str) else f"entry number {number}", part, get_args(kind)[0]
    elif isinstance(value, dict) and get_origin(kind) is dict:
        yield from ((key, part, get_args(kind)[1]) for key, part in value.items())
    elif isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        for field in msgspec.structs.fields(kind):
            if field.encode_name in value:
                yield field.encode_name, value[field.encode_name], field.type


_LONGEST_VALUE = 40
"""Most characters of a value that are shown."""


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str)
    if len(text) <= _LONGEST_VALUE:
        return text
    return f"{text[:_LONGEST_VALUE]}... ({len(value) if isinstance(value, str) else len(text)} characters)"
