"""What the names, comments and senders of a DBC say, in words.

Names of signals are split into words where case, digits or underscores change: ``SmoothBattCurrent132`` is *smooth batt
current 132*. Abbreviations of several houses stand beside each other, in English, German, French, Spanish, Italian and
Chinese.
"""

import re
import unicodedata
from collections.abc import Iterable

__all__ = ["CURRENT", "PLACES", "POSITIONS", "POWER", "VOLTAGE", "is_battery", "places_of", "word_set", "words_of"]

_SPLIT = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")

PLACES: dict[str, frozenset[str]] = {
    "battery": frozenset(
        {"battery", "batt", "bat", "bms", "pack", "pck", "accu", "akku", "accumulator", "hvb", "bdu"}
        | {"batterie", "bateria", "batteria", "becm", "lb", "lbc", "ess", "ress", "sme"}
    ),
    "motor": frozenset(
        {"motor", "mot", "inverter", "inv", "emotor", "machine", "edu", "mcu", "drive", "dif", "dir", "emachine", "tm"}
        | {"mtr", "em1", "mg", "pulswechselrichter", "wechselrichter", "antrieb", "maschine", "onduleur", "moteur"}
    ),
    "heater": frozenset(
        {"heater", "ptc", "heating", "heat", "htr", "heizer", "heizung", "heiz", "hzg", "chauffage"}
        | {"calefactor", "calefaccion", "riscaldatore"}
    ),
    "aircon": frozenset(
        {"compressor", "aircon", "ac", "cmpd", "cmp", "cmpr", "eac", "hvac", "airconditioning", "evap"}
        | {"klima", "kompressor", "komp", "klimageraet", "klimakompressor", "clim", "climatisation"}
    ),
    "dcdc": frozenset({"dcdc", "apm", "ldc", "gleichspannungswandler"}),
    "auxiliary": frozenset({"auxiliary", "aux", "auxiliaries", "verbraucher"}),
    "charger": frozenset(
        {"charger", "obc", "charge", "fc", "fastcharge", "evse", "chg", "chrg", "chrgr", "cp", "cc"}
        | {"lader", "ladegeraet", "laden", "kombiladeeinheit", "chargeur", "cargador"}
    ),
}
"""Where a current may flow, and words for it."""
POSITIONS = ("front", "rear", "left", "right")
"""Of branches that a vehicle has twice; numbers count where two signals differ in nothing else."""
CURRENT = frozenset(
    {"current", "curr", "crnt", "cur", "amp", "amps", "i", "strom", "courant", "corriente", "corrente", "stroom"}
)
VOLTAGE = frozenset(
    {"voltage", "volt", "volts", "vlt", "vltg", "u", "v", "uhv", "vdc", "spannung", "spg", "tension", "tensione"}
)
POWER = frozenset({"power", "pwr", "p", "pw", "watts", "leistung", "leist", "puissance", "potencia", "potenza"})
"""Words for what flows, in names without a unit."""


def word_set(text: str) -> frozenset[str]:
    """Words that stand apart in a text."""
    return frozenset(text.split())


_TRANSLATED = {
    "ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss",
    "电池": " battery ", "電池": " battery ", "电流": " current ", "電流": " current ", "电压": " voltage ",
    "電圧": " voltage ", "电机": " motor ", "電機": " motor ", "功率": " power ", "充电": " charger ",
    "加热": " heater ", "空调": " aircon ", "最大": " max ", "最小": " min ", "允许": " allowed ", "单体": " cell ",
    "请求": " request ", "전류": " current ", "전압": " voltage ", "배터리": " battery ", "모터": " motor ",
}  # fmt: skip
_JOINED = {
    "dc dc": "dcdc", "air con": "aircon", "air conditioning": "aircon", "e motor": "emotor", "low voltage": "lv",
    "high voltage": "hv", "h vlt": "hv", "em 1": "em1", "u lo": "ulo",
}  # fmt: skip
"""Words that mean something else apart."""
_LETTERS = {"i": "i", "u": "u", "v": "u", "p": "p", "hv": "hv", "lv": "lv"}
"""First letters of names such as ``Ibat`` and ``HVBatt``, when a place follows them."""
_GLUED = sorted((CURRENT | VOLTAGE | POWER) - set("iuvp") - {"cur", "amp", "volt"}, key=len, reverse=True)


def words_of(*texts: str | None) -> tuple[str, ...]:
    """Words of some names or sentences, in lower case.

    ``dc dc``, ``air con`` and ``low voltage`` are joined each; ``Ibat``, ``HVBatt`` and ``Batteriestrom`` are parted.
    """
    return tuple(word for text in texts if text for word in _joined(text))


def _joined(text: str) -> list[str]:
    for letters, translated in _TRANSLATED.items():
        text = text.replace(letters, translated)
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    words = f" {' '.join(part for word in _SPLIT.findall(plain) for part in _parted(word.lower()))} "
    for apart, together in _JOINED.items():
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
    """Places that some words name."""
    known = set(words)
    return {place for place, names in PLACES.items() if names & known}


def is_battery(name: str, signal: str) -> bool:
    """Whether a branch of this name, or else of this signal, is the battery."""
    named = places_of(words_of(name))
    return named == {"battery"} if named else "battery" in places_of(words_of(signal))
