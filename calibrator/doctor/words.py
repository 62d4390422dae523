"""What the names, comments and senders of a DBC say, in words.

Names of signals are split into words where case, digits or underscores change: ``SmoothBattCurrent132`` is *smooth batt
current 132*. Abbreviations of several houses stand beside each other, in English and German.
"""

import re
from collections.abc import Iterable

__all__ = ["PLACES", "is_battery", "places_of", "word_set", "words_of"]

_SPLIT = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")

PLACES: dict[str, frozenset[str]] = {
    "battery": frozenset({"battery", "batt", "bat", "bms", "pack", "accu", "hvb", "bdu", "traction", "batterie"}),
    "motor": frozenset(
        {"motor", "mot", "inverter", "inv", "emotor", "machine", "edu", "mcu", "drive", "dif", "dir", "emachine", "tm"}
        | {"pulswechselrichter", "wechselrichter", "antrieb", "maschine"}
    ),
    "heater": frozenset({"heater", "ptc", "heating", "htr", "heizer", "heizung", "hzg"}),
    "aircon": frozenset(
        {"compressor", "aircon", "ac", "cmpd", "cmp", "eac", "acc", "hvac", "airconditioning", "evap"}
        | {"klima", "kompressor", "komp", "klimageraet", "klimakompressor"}
    ),
    "dcdc": frozenset({"dcdc", "lv", "apm", "ldc", "gleichspannungswandler"}),
    "auxiliary": frozenset({"auxiliary", "aux", "auxiliaries"}),
    "charger": frozenset(
        {"charger", "obc", "charge", "fc", "fastcharge", "evse", "chg", "cp", "cc"}
        | {"lader", "ladegeraet", "laden", "kombiladeeinheit"}
    ),
}
"""Where a current may flow, and words for it."""


def word_set(text: str) -> frozenset[str]:
    """Words that stand apart in a text."""
    return frozenset(text.split())


_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})
_JOINED = {"dc dc": "dcdc", "air con": "aircon", "air conditioning": "aircon", "e motor": "emotor", "low voltage": "lv"}
"""Words that mean something else apart."""


def words_of(*texts: str | None) -> tuple[str, ...]:
    """Words of some names or sentences, in lower case; ``dc dc``, ``air con`` and ``low voltage`` are joined each."""
    return tuple(word for text in texts if text for word in _joined(text))


def _joined(text: str) -> list[str]:
    words = f" {' '.join(_SPLIT.findall(text.translate(_UMLAUTS))).lower()} "
    for apart, together in _JOINED.items():
        words = words.replace(f" {apart} ", f" {together} ")
    return words.split()


def places_of(words: Iterable[str]) -> set[str]:
    """Places that some words name."""
    known = set(words)
    return {place for place, names in PLACES.items() if names & known}


def is_battery(name: str, signal: str) -> bool:
    """Whether a branch of this name, or else of this signal, is the battery."""
    named = places_of(words_of(name))
    return named == {"battery"} if named else "battery" in places_of(words_of(signal))
