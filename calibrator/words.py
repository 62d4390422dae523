"""Split names, comments and senders of a DBC into words, and recognise words for places and quantities.

Names of signals are split where case, digits or underscores change: ``SmoothBattCurrent132`` becomes *smooth batt
current 132*. The known words are listed in ``vocabulary.toml``.
"""

import re
import tomllib
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from typing import Any

__all__ = [
    "CURRENT",
    "PLACES",
    "POSITIONS",
    "POWER",
    "VOCABULARY",
    "VOLTAGE",
    "is_battery",
    "places_of",
    "word_set",
    "words_of",
]

_SPLIT = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")


def word_set(text: str) -> frozenset[str]:
    """Return the set of the words of a text that are separated by white space."""
    return frozenset(text.split())


VOCABULARY: dict[str, Any] = tomllib.loads((Path(__file__).parent / "vocabulary.toml").read_text(encoding="utf-8"))
"""Content of ``vocabulary.toml``: words by meaning, each list one text with blanks between, as ``"volt vlt"``."""
PLACES = {place: word_set(words) for place, words in VOCABULARY["places"].items()}
"""Places where a current may flow (battery, motor, ...), each with the words for it."""
POSITIONS = ("front", "rear", "left", "right")
"""Words that tell apart branches that a vehicle has twice; numbers do so where two signals differ in nothing else."""
CURRENT, VOLTAGE, POWER = (word_set(VOCABULARY[quantity]) for quantity in ("current", "voltage", "power"))
"""Words for current, voltage and power in the names of signals that have no unit."""
_LETTERS = {"i": "i", "u": "u", "v": "u", "p": "p", "hv": "hv", "lv": "lv"}
"""Leading letters that are a word of their own if a place follows, as in ``Ibat`` and ``HVBatt``; and that word."""
_GLUED = sorted((CURRENT | VOLTAGE | POWER) - set("iuvp") - {"cur", "amp", "volt"}, key=len, reverse=True)
"""Words that are split off where they end another one, as in ``Batteriestrom``; the longest first."""


def words_of(*texts: str | None) -> tuple[str, ...]:
    """Return the words of names or sentences, in lower case.

    ``dc dc``, ``air con`` and ``low voltage`` become one word each; ``Ibat``, ``HVBatt`` and ``Batteriestrom`` are
    split into two.
    """
    return tuple(word for text in texts if text for word in _joined(text))


def _joined(text: str) -> list[str]:
    for letters, translated in VOCABULARY["translated"].items():
        text = text.replace(letters, translated)
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    words = f" {' '.join(part for word in _SPLIT.findall(plain) for part in _parted(word.lower()))} "
    for apart, together in VOCABULARY["joined"].items():
        words = words.replace(f" {apart} ", f" {together} ")
    return words.split()


def _parted(word: str) -> list[str]:
    for letters, meant in _LETTERS.items():
        if word.startswith(letters) and places_of([word.removeprefix(letters)]):
            return [meant, word.removeprefix(letters)]
    if not places_of([word]):
        for end in _GLUED:
            if word.endswith(end) and len(word) - len(end) > 1:
                head = word.removesuffix(end)
                return [*_parted(head[:-1] if places_of([head[:-1]]) and head[-1] == "s" else head), end]
    return [word]


def places_of(words: Iterable[str]) -> set[str]:
    """Return those :data:`PLACES` that one of the words stands for, such as ``{"battery"}``."""
    known = set(words)
    return {place for place, names in PLACES.items() if names & known}


def is_battery(name: str, signal: str) -> bool:
    """Check whether a branch is the battery, by its name; by the name of its signal if its own name tells no place."""
    named = places_of(words_of(name))
    return named == {"battery"} if named else "battery" in places_of(words_of(signal))
