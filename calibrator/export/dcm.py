"""DCM 2.0, the text format of calibration data of ETAS and Bosch ("Konservierung").

Every number is a FESTWERT, every text a TEXTSTRING; all belong to one function, whose version is the number of the
parameter set. The order of the keywords is that of the grammar ``dcm/DCM_2_0_grammar.g4`` of antlr/grammars-v4.
"""

from collections.abc import Iterator

from calibrator.export.characteristics import Characteristic, Note, characteristics, notes
from calibrator.export.checked import Checked

__all__ = ["dcm_text"]

_FUNCTION = "HV_current_correction"


def dcm_text(checked: Checked) -> str:
    """Write a parameter file as DCM.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    str
        The file, lines ended by LF; to be encoded as UTF-8.

    Raises
    ------
    ExportError
        If a text, such as the vehicle's name, has a character that DCM cannot hold.
    """
    texts = notes(checked)
    blocks = [
        "\n".join(_head(texts)),
        "KONSERVIERUNG_FORMAT 2.0",
        "\n".join(_functions(checked)),
        *("\n".join(_text(note)) for note in texts),
        *("\n".join(_number(item)) for item in characteristics(checked)),
    ]
    return "\n\n".join(blocks) + "\n"


def _head(texts: list[Note]) -> Iterator[str]:
    yield '* encoding="utf-8"'
    yield "* Corrections of high-voltage current sensors: true current = (measured - offset) / (1 + drift)"
    for note in texts:
        yield f"* {note.text}: {note.value}"


def _functions(checked: Checked) -> Iterator[str]:
    yield "FUNKTIONEN"
    yield f'  FKT {_FUNCTION} "{checked.parameters.number}" "correction of high-voltage current sensors"'
    yield "END"


def _text(note: Note) -> Iterator[str]:
    yield f"TEXTSTRING {note.name}"
    yield f'  LANGNAME "{note.text}"'
    yield f"  FUNKTION {_FUNCTION}"
    yield f'  TEXT "{note.value}"'
    yield "END"


def _number(item: Characteristic) -> Iterator[str]:
    yield f"FESTWERT {item.name}"
    if item.limits is not None:
        yield "* limits: {} to {}".format(*item.limits)
    yield f'  LANGNAME "{item.branch}: {item.text}"'
    yield f"  FUNKTION {_FUNCTION}"
    yield f'  EINHEIT_W "{item.unit}"'
    yield f"  WERT {int(item.value) if isinstance(item.value, bool) else item.value!r}"
    yield "END"
