"""C99: a parameter file as one header and one source, for control units on which no Python runs.

Both carry a mark made of their texts, and a header compiled with another export's source is an error: after a power cut
between the two files, or a half-done copy, nothing wrong is built.
"""

from hashlib import sha256

from calibrator.export.c_header import GUARD, header_body
from calibrator.export.c_model import c_program
from calibrator.export.c_source import source_body
from calibrator.export.checked import Checked

__all__ = ["HEADER", "SOURCE", "c99_files"]

HEADER, SOURCE = "hv_correction.h", "hv_correction.c"
_MARK_DIGITS = 8
"""32 bits: what every preprocessor can compare."""


def c99_files(checked: Checked) -> dict[str, str]:
    """Write a parameter file as C.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    dict of str to str
        Texts of header and source by their names.

    Raises
    ------
    LayoutError, DatabaseError
        If the node refuses layout or DBC.
    ExportError
        If a signal is too wide, or two names would be one in C.
    """
    program = c_program(checked)
    header, source = header_body(program), source_body(program)
    mark = f"0x{sha256((header + source).encode()).hexdigest()[:_MARK_DIGITS]}UL"
    include = f'#include "{HEADER}"\n\n#if HV_EXPORT != {mark}\n#error "{HEADER} is of another export"\n#endif\n'
    return {
        HEADER: f"#ifndef {GUARD}\n#define {GUARD}\n\n{header}\n#define HV_EXPORT {mark}\n\n#endif\n",
        SOURCE: f"/* Written by 'calibrator export'; do not edit. See {HEADER}. */\n{include}\n{source}",
    }
