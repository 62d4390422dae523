"""C functions that read and write a signal's own bits in a payload, byte by byte.

No byte is read as part of a wider word, so neither the byte order nor the alignment of the processor matters; nothing
is shifted that is signed, and nothing converted that does not fit.
"""

from collections.abc import Iterator
from typing import NamedTuple

from ecu_node.core.signals import BitPlace, PlacedSignal

__all__ = ["literal", "presence_function", "put_function", "reading_function"]

_BITS_PER_BYTE = 8
_BYTE = 0xFF
_WORD = 64
_LEAST = -(1 << (_WORD - 1))


class _Piece(NamedTuple):
    """The bits of a signal in one byte."""

    byte: int
    up: int
    """How far they stand above the byte's least significant bit."""
    ones: int
    down: int
    """How far they stand above the signal's least significant bit."""


def literal(number: int) -> str:
    """Write an int64_t as a constant of C."""
    return "INT64_MIN" if number == _LEAST else f"INT64_C({number})"


def reading_function(name: str, place: BitPlace) -> list[str]:
    """A function that reads the code of a signal from a payload that is long enough.

    Parameters
    ----------
    name : str
        Of the function.
    place : BitPlace
        Where the signal stands.

    Returns
    -------
    list of str
        Lines of C. An unsigned code of 2^63 or more comes out negative, with the same bits.
    """
    joined = "\n        | ".join(_up(f"(uint64_t){_bits(piece)}", piece.down) for piece in _pieces(place))
    lines = [
        f"static int64_t {name}(const uint8_t *payload)",
        "{",
        f"    const uint64_t raw = {joined};",
        "",
    ]
    if place.length == _WORD:
        lines.append("    return as_signed(raw);")
    elif place.signed:
        sign = 1 << (place.length - 1)
        lines.append(f"    return (int64_t)(raw ^ UINT64_C(0x{sign:X})) - INT64_C(0x{sign:X});")
    else:
        lines.append("    return (int64_t)raw;")
    return [*lines, "}"]


def put_function(name: str, place: BitPlace) -> list[str]:
    """A function that writes the code of a signal into a payload that is long enough; all other bits stay.

    Parameters
    ----------
    name : str
        Of the function.
    place : BitPlace
        Where the signal stands.

    Returns
    -------
    list of str
        Lines of C.
    """
    lines = [f"static void {name}(uint8_t *payload, int64_t code)", "{", "    const uint64_t raw = (uint64_t)code;", ""]
    for piece in _pieces(place):
        kept = _BYTE & ~(piece.ones << piece.up)
        bits = f"{_down('raw', piece.down)} & 0x{piece.ones:02X}U"
        new = f"(payload[{piece.byte}] & 0x{kept:02X}U) | {_up(f'({bits})', piece.up)}" if kept else bits
        lines.append(f"    payload[{piece.byte}] = (uint8_t)({new});")
    return [*lines, "}"]


def presence_function(name: str, signal: PlacedSignal) -> list[str]:
    """Functions that tell whether a payload has a signal: it is long enough, and its multiplexers have the right codes.

    Parameters
    ----------
    name : str
        Of the function; those of its multiplexers have a number behind it.
    signal : PlacedSignal
        The signal.

    Returns
    -------
    list of str
        Lines of C.
    """
    lines: list[str] = []
    tests = [f"length >= {signal.end}U"]
    for number, item in enumerate(signal.above):
        lines += [*reading_function(f"{name}_by_{number}", item.place), ""]
        code = f"{name}_by_{number}(payload)"
        choices = " || ".join(_between(code, first, last) for first, last in _runs(sorted(item.codes)))
        tests.append(f"({choices})")
    unused = [] if signal.above else ["    (void)payload;"]
    return [
        *lines,
        f"static bool {name}(const uint8_t *payload, size_t length)",
        "{",
        *unused,
        "    return " + "\n        && ".join(tests) + ";",
        "}",
    ]


def _bits(piece: _Piece) -> str:
    """The bits of a signal in one byte, as a number."""
    byte = _down(f"payload[{piece.byte}]", piece.up)
    return byte if piece.ones == _BYTE else f"({byte} & 0x{piece.ones:02X}U)"


def _up(text: str, bits: int) -> str:
    return f"({text} << {bits}U)" if bits else text


def _down(text: str, bits: int) -> str:
    return f"({text} >> {bits}U)" if bits else text


def _pieces(place: BitPlace) -> Iterator[_Piece]:
    for number in range(place.end - place.first):
        low = max(_BITS_PER_BYTE * number, place.shift)
        high = min(_BITS_PER_BYTE * (number + 1), place.shift + place.length)
        yield _Piece(
            byte=place.first + number if place.order == "little" else place.end - 1 - number,
            up=low - _BITS_PER_BYTE * number,
            ones=(1 << (high - low)) - 1,
            down=low - place.shift,
        )


def _runs(codes: list[int]) -> Iterator[tuple[int, int]]:
    """Unbroken runs of codes, first and last."""
    first = 0
    for k in range(1, len(codes) + 1):
        if k == len(codes) or codes[k] != codes[k - 1] + 1:
            yield codes[first], codes[k - 1]
            first = k


def _between(code: str, first: int, last: int) -> str:
    if first == last:
        return f"{code} == {literal(first)}"
    return f"({code} >= {literal(first)} && {code} <= {literal(last)})"
