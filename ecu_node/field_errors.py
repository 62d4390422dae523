"""What is wrong with one field of a document, in words: where it stands, what was found, what is expected.

msgspec says it as ``Expected `float`, got `str` - at `$.branch[2].timeout_s```. Here the place becomes steps into the
document, of which :func:`field_error` makes words that a user finds again in the file.
"""

import codecs
import difflib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import reduce
from operator import getitem
from typing import Any

import msgspec
from msgspec import inspect

__all__ = ["Place", "field_error", "json_error", "quoted_place", "toml_place"]

Step = str | int
Place = tuple[Step, ...]
"""Keys and indices that lead from the top of a document to a field."""

_MESSAGE = re.compile(r"(?P<what>.*?)(?: - at `(?P<in_key>key in )?\$?(?P<path>.*)`)?", re.DOTALL)
_STEP = re.compile(r"\.(?P<key>\w+)|\[(?P<index>\d+)\]|(?P<any>\[\.\.\.\])")
_LENGTH = re.compile(r" of length (?P<relation>[<>])= (?P<number>\d+)")
_WORDS = {
    "array": "a list",
    "bool": "true or false",
    "float": "a number",
    "int": "a whole number",
    "object": "a table",
    "str": "a text",
}
_LONGEST_VALUE = 40
"""Characters of a value that are shown."""


def field_error(error: msgspec.ValidationError, document: Any, schema: Any, place: Callable[[Any, Place], str]) -> str:
    """Say what is wrong with a document that does not fit its schema.

    Parameters
    ----------
    error : msgspec.ValidationError
        From converting the document.
    document : object
        The document as plain dicts, lists, texts and numbers, without a key that stood twice in its file.
    schema : type
        What it was converted to.
    place : callable
        Makes words of a place in the document: :func:`toml_place` or :func:`quoted_place`.

    Returns
    -------
    str
        One line, such as ``[[branch]] 'heater', timeout_s: a number is expected, found "x"``.
    """
    match = _MESSAGE.fullmatch(str(error))
    assert match is not None, "the pattern matches every text"
    steps = _steps(match["path"] or "", document, schema)
    words = place(document, steps)
    what = _what(match["what"], _found(document, steps), _kind(schema, document, steps))
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
    outer = _found(document, steps[:1])
    entry = _found(document, steps[:2])
    words: list[str] = []
    if isinstance(outer, list) and isinstance(entry, Mapping):
        name = entry.get("name")
        words = [f"[[{steps[0]}]] {name!r}" if isinstance(name, str) else f"[[{steps[0]}]] {_step_words(steps[1])}"]
        steps = steps[2:]
    elif steps and isinstance(outer, Mapping):
        words, steps = [f"[{steps[0]}]"], steps[1:]
    return ", ".join([*words, *map(_step_words, steps)])


def quoted_place(document: Any, steps: Place) -> str:  # noqa: ARG001  # the other place needs the document
    """Place in a JSON file: its keys from the outside to the inside."""
    return ", ".join(repr(step) if isinstance(step, str) else _step_words(step) for step in steps)


def _step_words(step: Step) -> str:
    return f"entry number {step + 1}" if isinstance(step, int) else step


def _steps(path: str, document: Any, schema: Any) -> Place:
    """Steps of a path; where msgspec writes ``[...]`` for any key of a dict, the key that the error is about."""
    steps: Place = ()
    for match in _STEP.finditer(path):
        if match["any"]:
            steps += _culprit(document, steps, schema)
        else:
            steps += (int(match["index"]) if match["index"] else match["key"],)
    return steps


def _culprit(document: Any, steps: Place, schema: Any) -> Place:
    """The first key of a dict with which alone the document does not fit either."""
    table = _found(document, steps)
    entries = table.items() if isinstance(table, Mapping) else ()
    alone = ((key, _replaced(document, steps, {key: value})) for key, value in entries)
    return next(((key,) for key, changed in alone if not _fits(changed, schema)), ())


def _fits(document: Any, schema: Any) -> bool:
    try:
        msgspec.convert(document, schema)
    except msgspec.ValidationError:
        return False
    return True


def _replaced(document: Any, steps: Place, value: Any) -> Any:
    """Copy of a document with another value at a place."""
    if not steps:
        return value
    copy = document.copy()
    copy[steps[0]] = _replaced(document[steps[0]], steps[1:], value)
    return copy


def _found(document: Any, steps: Place) -> Any:
    """Value at a place; None where there is none."""
    found = None
    with suppress(LookupError, TypeError):
        found = reduce(getitem, steps, document)
    return found


def _kind(schema: Any, document: Any, steps: Place) -> inspect.Type | None:
    """What the schema expects at a place; None if it says nothing of it."""
    kinds = list(_alternatives(inspect.type_info(schema)))
    for depth, step in enumerate(steps, start=1):
        found = _found(document, steps[:depth])
        inside = (inner for kind in kinds for inner in _alternatives(_inside(kind, step)))
        kinds = [kind for kind in inside if _may_be(kind, found)]
    return kinds[0] if kinds else None


def _may_be(kind: inspect.Type, found: Any) -> bool:
    """Whether this alternative is meant, by the tag that tells some of them apart."""
    if not isinstance(kind, inspect.StructType) or kind.tag_field is None or not isinstance(found, Mapping):
        return True
    return bool(found.get(kind.tag_field) == kind.tag)


def _inside(kind: inspect.Type, step: Step) -> inspect.Type | None:
    if isinstance(kind, inspect.StructType):
        return next((field.type for field in kind.fields if field.encode_name == step), None)
    if isinstance(kind, inspect.ListType):
        return kind.item_type
    return kind.value_type if isinstance(kind, inspect.DictType) else None


def _alternatives(kind: inspect.Type | None) -> Iterator[inspect.Type]:
    """The kinds that a kind may be, without null and without descriptions."""
    if isinstance(kind, inspect.Metadata):
        yield from _alternatives(kind.type)
    elif isinstance(kind, inspect.UnionType):
        for one in kind.types:
            yield from _alternatives(one)
    elif kind is not None and not isinstance(kind, inspect.NoneType):
        yield kind


def _what(text: str, found: Any, kind: inspect.Type | None) -> str:
    if missing := re.fullmatch(r"Object missing required field `(.*)`", text):
        return f"'{missing[1]}' is missing"
    if unknown := re.fullmatch(r"Object contains unknown field `(.*)`", text):
        return _unknown_key(unknown[1], kind)
    if isinstance(kind, inspect.LiteralType):
        return f"{' or '.join(map(repr, kind.values))} is expected, found {_shown(found)}"
    expected = re.fullmatch(r"Expected `(\w+)[^`]*`(?:, got `.*`)?(.*)", text, re.DOTALL)
    if expected is None:
        return f"{text}, found {_shown(found)}"
    words = _WORDS.get(expected[1], expected[1])
    if expected[2].startswith(" matching regex"):
        words = _pattern_words(expected[2])
    elif length := _LENGTH.fullmatch(expected[2]):
        bound = "at least" if length["relation"] == ">" else "at most"
        words += f" of {bound} {_count_words(int(length['number']), is_text=expected[1] == 'str')}"
    else:
        words += expected[2]
    return f"{words} is expected, found {_shown(found)}"


def _count_words(number: int, *, is_text: bool) -> str:
    one, more = ("character", "characters") if is_text else ("entry", "entries")
    return f"{number} {one if number == 1 else more}"


def _pattern_words(text: str) -> str:
    """Words for the patterns of names, of signals and of digests, each known by a part of its own."""
    if "x1f" in text:
        return "'Message.Signal' as in the DBC, or a column without blanks at its ends,"
    return "a name of letters, digits and _" if "A-Za-z_" in text else "a text of 64 digits 0-9 and a-f"


def _unknown_key(key: str, kind: inspect.Type | None) -> str:
    fields, tag = (kind.fields, kind.tag_field) if isinstance(kind, inspect.StructType) else ((), None)
    allowed = [*([tag] if tag else []), *(field.encode_name for field in fields)]
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
