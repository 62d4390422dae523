"""Columns of numbers as text of an HTML page, and the way back: whole numbers, byte planes, gzip, base64.

A page of 100,000 vehicles has some ten million numbers. As whole multiples of what a reader can see (a milliampere, a
thousandth of a percent), bytes of equal weight beside each other, they need about a tenth of what they need as text.
"""

import base64
import gzip
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array

__all__ = ["MISSING", "Packed", "as_text", "pack"]

MISSING = -(2**31)
"""Stands for what is not known."""
_LARGEST = 2**31 - 1
LEVEL = 6
"""Of compression: the highest takes four times as long for a hundredth less."""


@dataclass(frozen=True, kw_only=True)
class Packed:
    """Some columns.

    Attributes
    ----------
    columns : list of dict
        Name, step and length of each, in the order in which they stand in the data; ``value = step * number``.
    data : str
        Base64 of gzip of the columns, each as its four planes of bytes, little-endian int32.
    """

    columns: list[dict[str, str | float | int]]
    data: str


def pack(columns: Mapping[str, tuple[Array, float]]) -> Packed:
    """Pack columns.

    Parameters
    ----------
    columns : mapping of str to (ndarray, float)
        Values of any shape, read row by row, and the step that they are rounded to. What is not finite is missing.

    Returns
    -------
    Packed
        To be put into a page.
    """
    about: list[dict[str, str | float | int]] = []
    planes: list[bytes] = []
    for name, (values, step) in columns.items():
        whole = _whole(values, step)
        about.append({"name": name, "step": step, "length": len(whole)})
        planes.append(np.ascontiguousarray(whole.view(np.uint8).reshape(-1, 4).T).tobytes())
    return Packed(columns=about, data=as_text(b"".join(planes)))


def as_text(content: bytes) -> str:
    """Base64 of gzip of some bytes; the same for the same bytes."""
    return base64.b64encode(gzip.compress(content, compresslevel=LEVEL, mtime=0)).decode()


def _whole(values: Array, step: float) -> NDArray[np.int32]:
    flat = np.asarray(values, np.float64).ravel() / step
    finite = np.isfinite(flat)
    rounded = np.clip(np.rint(np.where(finite, flat, 0.0)), MISSING + 1, _LARGEST)
    return np.where(finite, rounded, MISSING).astype("<i4")
