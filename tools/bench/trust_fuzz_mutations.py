"""Ways to change a signed file: its bytes, its JSON, its base64, its signatures, and the statement inside.

Each takes a source of random numbers, a file, and another valid one to take parts from. What comes of it may be the
same file again, or may be no JSON at all.
"""

import base64
import json
import re
from collections.abc import Callable
from random import Random
from typing import Any

import rfc8785

__all__ = ["MUTATIONS", "changed_document", "wrapped"]

Mutation = Callable[[Random, bytes, bytes], bytes]

_TOKENS = (
    *(b"NaN", b"Infinity", b"-Infinity", b"-0", b"1e999", b"1e-999", b"0x10", b"01", b"1.0", b"1E5", b"9" * 400),
    *(b"null", b"true", b"{}", b"[]", b'""', b'"\\u0000"', b'"\\ud800"', b'"\\u0061"', b"//", b"/**/", b",", b"'"),
    *(
        b"\xff",
        b"\xc0\x80",
        b"\xed\xa0\x80",
        b"\xef\xbb\xbf",
        b"\xe2\x80\xae",
        b"\x00",
        b"\r\n",
        b"\x1b[2J",
        b" ",
        b"\t",
    ),
    *(b"[" * 2000, b'{"a":' * 2000, b"[" * 30000 + b"]" * 30000),
)
_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e[+-]?\d+)?")
_BASE64 = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/=-_ \n"


def _nested(depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = [value]
    return value


_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 8, 1 << 31, (1 << 53) - 1, 1 << 53, 1 << 64, 10**40, -(10**19)),
    *(0.5, -0.0, 1e-320, 1e21, 1.7e308, 1e16, "", "v1", "v\u0131", "\u202e", "\n", "\x00", "a" * 1000, "\U0001f697"),
    *("0" * 64, "2026-06-01T12:00:00Z", "9999-99-99T99:99:99Z", "2026-06-01T12:00:00Z\n", "\u0660" * 4, "NaN"),
    *([], {}, [[]], {"": {}}, _nested(5), _nested(150), list(range(100))),
)


def _flipped(rng: Random, file: bytes, _: bytes) -> bytes:
    changed = bytearray(file)
    for bit in rng.choices(range(8 * len(file)), k=rng.choice((1, 1, 1, 2, 5))):
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def _cut(rng: Random, file: bytes, _: bytes) -> bytes:
    return file[: rng.randrange(len(file))]


def _left_out(rng: Random, file: bytes, _: bytes) -> bytes:
    start = rng.randrange(len(file))
    return file[:start] + file[start + rng.randint(1, 40) :]


def _inserted(rng: Random, file: bytes, _: bytes) -> bytes:
    place = rng.choice((0, len(file), rng.randrange(len(file))))
    what = rng.choice(_TOKENS) if rng.random() < 0.5 else rng.randbytes(rng.randint(1, 20))
    return file[:place] + what + file[place:]


def _repeated(rng: Random, file: bytes, _: bytes) -> bytes:
    start = rng.randrange(len(file))
    stop = start + rng.randint(1, 200)
    return file[:stop] + file[start:stop] + file[stop:]


def _spliced(rng: Random, file: bytes, other: bytes) -> bytes:
    start = rng.randrange(len(file))
    stop, place = start + rng.randint(0, 300), rng.randrange(len(other))
    if rng.random() < 0.5:
        return file[:start] + other[start:]
    return file[:start] + other[place : place + stop - start] + file[stop:]


def _other_number(rng: Random, file: bytes, _: bytes) -> bytes:
    found = rng.choice(list(_NUMBER.finditer(file)))
    return file[: found.start()] + rng.choice(_TOKENS) + file[found.end() :]


def _repeated_key(rng: Random, file: bytes, _: bytes) -> bytes:
    key = rng.choice((b'"payload":', b'"payloadType":', b'"signatures":', b'"keyid":', b'"sig":'))
    value = json.dumps(rng.choice(_VALUES)).encode()
    return file.replace(key, key + value + b"," + key, 1)


def _other_text(rng: Random, file: bytes, _: bytes) -> bytes:
    """The same values in another text."""
    document = json.loads(file)
    writer: Callable[[Any], str] = rng.choice(
        (
            json.dumps,
            lambda value: json.dumps(value, indent=rng.randint(0, 4)),
            lambda value: json.dumps(dict(reversed(value.items())), separators=(",", ":")),
            lambda value: "".join(f"\\u{ord(char):04x}" if char == "a" else char for char in json.dumps(value)),
        )
    )
    encoding = rng.choice(("utf-8", "utf-16", "utf-8-sig", "utf-32"))
    return (writer(document) + "\n").encode(encoding)


def _other_envelope(rng: Random, file: bytes, _: bytes) -> bytes:
    return _text(changed_document(rng, json.loads(file)))


def _other_statement(rng: Random, file: bytes, _: bytes) -> bytes:
    """Another statement under the signatures of this one."""
    envelope = json.loads(file)
    statement = changed_document(rng, json.loads(base64.b64decode(envelope["payload"])))
    return _text({**envelope, "payload": wrapped(_text(statement)[:-1])})


def _other_base64(rng: Random, file: bytes, _: bytes) -> bytes:
    envelope = json.loads(file)
    item = rng.choice([envelope, *envelope["signatures"]])
    key = "payload" if item is envelope else "sig"
    text = bytearray(item[key].encode())
    place = len(text) - 1 - rng.randrange(4) if rng.random() < 0.5 else rng.randrange(len(text))
    chance = rng.random()
    if chance < 0.5:
        text[place] = rng.choice(_BASE64)
    elif chance < 0.7:
        text.insert(place, rng.choice(_BASE64))
    elif chance < 0.85:
        del text[place:]
    else:
        text += rng.choice((b"=", b"==", b"====", b"AAAA", b"\n", bytes(text)))
    item[key] = text.decode()
    return _text(envelope)


def _other_signatures(rng: Random, file: bytes, other: bytes) -> bytes:
    envelope = json.loads(file)
    mine, others = envelope["signatures"], json.loads(other)["signatures"]
    one = dict(rng.choice(mine))
    envelope["signatures"] = rng.choice(
        (
            others,
            [mine[0], *others],
            mine[:1],
            [one, one],
            list(reversed(mine)),
            [],
            [{**item, "sig": one["sig"]} for item in mine],
            [{**item, "keyid": rng.choice(others)["keyid"]} for item in mine],
            [{**item, "sig": wrapped(rng.randbytes(64))} for item in mine],
            [{**item, "sig": wrapped(bytes(64))} for item in mine],
            mine * 20,
        )
    )
    return _text(envelope)


def _other_kind(rng: Random, file: bytes, other: bytes) -> bytes:
    kind = rng.choice((json.loads(other)["payloadType"], "text/plain", "", "application/json", "a" * 200))
    return _text({**json.loads(file), "payloadType": kind})


def _noise(rng: Random, _: bytes, __: bytes) -> bytes:
    return rng.randbytes(rng.choice((0, 1, 10, 1000)))


MUTATIONS: tuple[Mutation, ...] = (
    *(_flipped, _cut, _left_out, _inserted, _repeated, _spliced, _other_number, _repeated_key, _other_text),
    *(_other_envelope, _other_statement, _other_base64, _other_signatures, _other_kind, _noise),
)
"""All of them."""


def changed_document(rng: Random, document: Any) -> Any:
    """A JSON document with one to three changes: a value, a key that is left out, added or renamed, an entry twice."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        document = _changed(rng, document)
    return document


def _changed(rng: Random, node: Any) -> Any:
    goes_in = bool(node) and rng.random() < 0.85
    if goes_in and isinstance(node, dict):
        return _changed_table(rng, node)
    if goes_in and isinstance(node, list):
        place = rng.randrange(len(node))
        entries = [node[place]] * 2 if rng.random() < 0.2 else [_changed(rng, node[place])]
        return [*node[:place], *entries, *node[place + 1 :]]
    return _like(rng, node) if rng.random() < 0.7 else rng.choice(_VALUES)


def _like(rng: Random, value: Any) -> Any:
    """Another value of the same type, so that it comes past the schema."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float) and rng.random() < 0.7:
        return rng.choice((value + 1, -value, value * 3, value * 10**6, value + rng.uniform(-1.0, 1.0)))
    return rng.choice([item for item in _VALUES if type(item) is type(value)] or _VALUES)


def _changed_table(rng: Random, table: dict[str, Any]) -> dict[str, Any]:
    key, chance = rng.choice(list(table)), rng.random()
    if chance < 0.1:
        return {name: value for name, value in table.items() if name != key}
    if chance < 0.2:
        return {**table, rng.choice((key + "x", "", "\n", "b\u00e4r", "a" * 500)): rng.choice(_VALUES)}
    return {**table, key: _changed(rng, table[key])}


def wrapped(content: bytes) -> str:
    """Base64 of a content."""
    return base64.b64encode(content).decode()


def _text(document: Any) -> bytes:
    """Canonical JSON with a line end; other JSON where there is no canonical one."""
    try:
        return rfc8785.dumps(document) + b"\n"
    except (rfc8785.CanonicalizationError, ValueError, RecursionError):
        return json.dumps(document).encode(errors="replace") + b"\n"
