"""What is wrong with one field of a document, in words: where it stands, what was found, what is expected.

msgspec checks a document, and says yes or no. To say why not in the words of the file's author, the document is walked
beside the structures that it should have.
"""

import codecs
import difflib
import json
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

from msgspec import inspect

__all__ = ["Place", "field_error", "json_error", "quoted_place", "repeated_key", "toml_place"]

Step = str | int
Place = tuple[Step, ...]
"""Keys and indices that lead from the top of a document to a field."""

_type_info = cache(inspect.type_info)
_LONGEST_VALUE = 40
"""Characters of a value that are shown."""


def field_error(error: Exception, document: Any, schema: Any, place: Callable[[Any, Place], str]) -> str:
    """Say what is wrong with a document that does not fit its schema.

    Parameters
    ----------
    error : Exception
        Of the library that found it out; said where the walk below finds nothing.
    document : object
        The document as plain dicts, lists, texts and numbers, without a key that stood twice in its file.
    schema : type
        What it was converted to, a structure of msgspec.
    place : callable
        Makes words of a place in the document: :func:`toml_place` or :func:`quoted_place`.

    Returns
    -------
    str
        One line, such as ``[[branch]] 'heater', timeout_s: a number is expected, found "x"``.
    """
    steps, what = next(_problems(_type_info(schema), document, ()), ((), str(error)))
    words = place(document, steps)
    return f"{words}: {what}" if words else what


def json_error(error: Exception, content: bytes) -> str:
    """Say why a text is no JSON; other errors of its decoding in the words that they have."""
    if not content.strip():
        return "it is empty"
    if content.startswith(codecs.BOM_UTF8):
        return "it begins with a byte order mark (BOM); save it as UTF-8 without one"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return "it is no text in UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)


def toml_place(document: Any, steps: Place) -> str:
    """Place in a TOML file: its table, with the name of an entry of a list of tables, then the key."""
    outer = document[steps[0]] if steps else None
    entry = document[steps[0]][steps[1]] if isinstance(outer, list) and len(steps) > 1 else None
    words: list[str] = []
    if isinstance(entry, Mapping):
        name = entry.get("name")
        words = [f"[[{steps[0]}]] {repr(name) if isinstance(name, str) else _step_words(steps[1])}"]
        steps = steps[2:]
    elif isinstance(outer, Mapping):
        words, steps = [f"[{steps[0]}]"], steps[1:]
    return ", ".join([*words, *map(_step_words, steps)])


def quoted_place(document: Any, steps: Place) -> str:  # noqa: ARG001  # the other place needs the document
    """Place in a JSON file: its keys from the outside to the inside."""
    return ", ".join(repr(step) if isinstance(step, str) else _step_words(step) for step in steps)


def _step_words(step: Step) -> str:
    return f"entry number {step + 1}" if isinstance(step, int) else step


def _problems(kind: inspect.Type, value: Any, steps: Place) -> Iterator[tuple[Place, str]]:
    """Places in a value that are not of their kind, the first one first, and why not."""
    kinds = _alternatives(kind)
    if value is None and any(isinstance(one, inspect.NoneType) for one in kinds):
        return
    kinds.sort(key=lambda one: (isinstance(one, inspect.NoneType), not _may_be(one, value)))
    match kinds[0]:
        case inspect.NoneType():
            yield steps, f"null is expected, found {_shown(value)}"
        case inspect.StructType() as struct:
            yield from _of_struct(struct, value, steps)
        case inspect.DictType() | inspect.ListType() as many:
            yield from _of_many(many, value, steps)
        case inspect.LiteralType(values=values):
            if not any(value == one and type(value) is type(one) for one in values):
                yield steps, f"{' or '.join(map(repr, values))} is expected, found {_shown(value)}"
        case one:
            expected = _expected(one, value)
            if expected is not None:
                yield steps, f"{expected} is expected, found {_shown(value)}"


def _of_struct(kind: inspect.StructType, value: Any, steps: Place) -> Iterator[tuple[Place, str]]:
    if not isinstance(value, Mapping):
        yield steps, f"a table is expected, found {_shown(value)}"
        return
    fields = {field.encode_name: field for field in kind.fields}
    tag = [kind.tag_field] if kind.tag_field else []
    for key, inner in value.items():
        if key in fields:
            yield from _problems(fields[key].type, inner, (*steps, key))
        elif key not in tag:
            yield steps, _unknown_key(key, [*tag, *fields])
    for key, field in fields.items():
        if field.required and key not in value:
            yield steps, f"'{key}' is missing"


def _of_many(kind: inspect.DictType | inspect.ListType, value: Any, steps: Place) -> Iterator[tuple[Place, str]]:
    words, wanted = ("a list", list) if isinstance(kind, inspect.ListType) else ("a table", Mapping)
    if not isinstance(value, wanted):
        yield steps, f"{words} is expected, found {_shown(value)}"
    elif (wrong := _wrong_length(kind, value, "entry", "entries")) is not None:
        yield steps, f"{words} of {wrong} is expected, found {_shown(value)}"
    else:
        inner = kind.item_type if isinstance(kind, inspect.ListType) else kind.value_type
        for step, one in enumerate(value) if isinstance(value, list) else value.items():
            yield from _problems(inner, one, (*steps, step))


def _expected(kind: inspect.Type, value: Any) -> str | None:
    """What a plain value should be; None if it is."""
    if isinstance(kind, inspect.IntType | inspect.FloatType):
        return _expected_number(kind, value)
    if isinstance(kind, inspect.StrType):
        if not isinstance(value, str):
            return "a text"
        if (wrong := _wrong_length(kind, value, "character", "characters")) is not None:
            return f"a text of {wrong}"
        return None if kind.pattern is None or re.search(kind.pattern, value) else _pattern_words(kind.pattern)
    return "true or false" if isinstance(kind, inspect.BoolType) and not isinstance(value, bool) else None


def _expected_number(kind: inspect.IntType | inspect.FloatType, value: Any) -> str | None:
    is_whole = isinstance(kind, inspect.IntType)
    words = "a whole number" if is_whole else "a number"
    if isinstance(value, bool) or not isinstance(value, int | float) or (is_whole and value % 1 != 0):
        return words
    for sign, limit, holds in (
        (">=", kind.ge, operator.ge),
        (">", kind.gt, operator.gt),
        ("<=", kind.le, operator.le),
        ("<", kind.lt, operator.lt),
    ):
        if limit is not None and not holds(value, limit):
            return f"{words} {sign} {limit}"
    return None


def _wrong_length(kind: Any, value: Any, one: str, more: str) -> str | None:
    """Which length is wanted of a text, list or table; None if it has it."""
    if kind.min_length is not None and len(value) < kind.min_length:
        return f"at least {kind.min_length} {one if kind.min_length == 1 else more}"
    if kind.max_length is not None and len(value) > kind.max_length:
        return f"at most {kind.max_length} {one if kind.max_length == 1 else more}"
    return None


def _alternatives(kind: inspect.Type) -> list[inspect.Type]:
    """The kinds that a kind may be, without descriptions."""
    bare = kind.type if isinstance(kind, inspect.Metadata) else kind
    return (
        [one for inner in bare.types for one in _alternatives(inner)] if isinstance(bare, inspect.UnionType) else [bare]
    )


def _may_be(kind: inspect.Type, value: Any) -> bool:
    """Whether this alternative is meant: a list, a table, or the structure whose tag stands there."""
    if isinstance(value, list):
        return isinstance(kind, inspect.ListType)
    if not isinstance(value, Mapping):
        return True
    if isinstance(kind, inspect.StructType) and kind.tag_field is not None:
        return bool(value.get(kind.tag_field) == kind.tag)
    return isinstance(kind, inspect.StructType | inspect.DictType)


def _pattern_words(pattern: str) -> str:
    """Words for the patterns of names, of signals and of digests, each known by a part of its own."""
    if "x1f" in pattern:
        return "'Message.Signal' as in the DBC, or a column without blanks at its ends,"
    return "a name of letters, digits and _" if "_A-Za-z" in pattern else "a text of 64 digits 0-9 and a-f"


def _unknown_key(key: str, allowed: list[str]) -> str:
    near = difflib.get_close_matches(key, allowed, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"unknown key '{key}'; {hint}allowed are {', '.join(allowed)}"


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = json.dumps(value, default=str)
    if len(text) <= _LONGEST_VALUE:
        return text
    return f"{text[:_LONGEST_VALUE]}..." + (f" ({len(value)} characters)" if isinstance(value, str) else "")


class _TwiceError(Exception):
    """Carries the key out of the parser."""

    def __init__(self, key: str) -> None:
        super().__init__(key)
        self.key = key


def repeated_key(content: bytes) -> str | None:
    """Find the first key that stands twice in one object; None if there is none.

    Parameters
    ----------
    content : bytes
        Sound JSON.
    """
    try:
        json.loads(content, object_pairs_hook=_once_each, parse_float=str, parse_int=str)
    except _TwiceError as error:
        return error.key
    return None


def _once_each(pairs: list[tuple[str, Any]]) -> None:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        raise _TwiceError(next(key for place, key in enumerate(keys) if key in keys[:place]))
