"""CSV tables of numbers whose errors name file, column and line."""

import gzip
import zlib
from pathlib import Path

import numpy as np

from calibrator.drive import Array
from calibrator.errors import LogError

__all__ = ["CsvTable", "read_csv_table"]

_HEADER_LINES = 1
_NO_NUMBER = {"", "nan", "na", "null"}
"""Cells that say there is no value, lower case."""


class CsvTable:
    """The cells of a file, turned into numbers column by column.

    Attributes
    ----------
    where : str
        The file's name, for messages.
    """

    def __init__(self, where: str, header: list[str], rows: list[list[str]], lines: list[int]) -> None:
        self.where = where
        self._header = header
        self._rows = rows
        self._lines = lines

    def line(self, row: int) -> int:
        """Line of the file that a row stands in, counted from 1."""
        return self._lines[row]

    def numbers(self, column: str) -> Array:
        """Return one column.

        Parameters
        ----------
        column : str
            Its header.

        Returns
        -------
        ndarray of shape (rows,)
            Values; NaN where the cell is empty or says NaN.

        Raises
        ------
        LogError
            If the column is missing or there twice, or a cell is neither a number nor empty.
        """
        count = self._header.count(column)
        if count != 1:
            known = ", ".join(name for name in self._header if name)
            fault = "there is no column" if count == 0 else f"{count} columns have the header"
            raise LogError(f"{self.where}: {fault} '{column}'; the columns are {known}; correct the header")
        index = self._header.index(column)
        cells = ["nan" if row[index].lower() in _NO_NUMBER else row[index] for row in self._rows]
        try:
            return np.array(cells).astype(np.float64)
        except ValueError:
            row = next(row for row, cell in enumerate(cells) if not _is_number(cell))
            raise LogError(
                f"{self.where}: line {self.line(row)}, column '{column}': {cells[row][:40]!r} is not a number; "
                f"correct the cell, or leave it empty"
            ) from None

    def require_increasing(self, column: str) -> None:
        """Raise :class:`LogError` unless a column, which is the time, increases from line to line."""
        values = self.numbers(column)
        fault = ~(np.diff(values, prepend=-np.inf) > 0.0)
        if fault.any():
            row = int(np.argmax(fault))
            cell = self._rows[row][self._header.index(column)]
            raise LogError(
                f"{self.where}: line {self.line(row)}, column '{column}': {cell or 'an empty cell'} does not come "
                f"after the line before; time must increase, remove repeated or misplaced lines"
            )


def read_csv_table(path: Path, *, delimiter: str, encoding: str) -> CsvTable:
    """Read a CSV file, also gzipped. Lines with fewer cells than the header count as cut.

    Parameters
    ----------
    path : Path
        The file.
    delimiter, encoding : str
        How it is written.

    Returns
    -------
    CsvTable
        Header and cells, without blanks around them.

    Raises
    ------
    LogError
        If the file cannot be read, is empty or has a cut line.
    """
    try:
        data = path.read_bytes()
        text = (gzip.decompress(data) if path.suffix.lower() == ".gz" else data).decode(encoding)
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise LogError(f"{path}: cannot be read: {reason}; copy the file again") from None
    lines = text.splitlines()
    kept = [number for number, line in enumerate(lines, start=1) if line.strip()]
    if len(kept) <= _HEADER_LINES:
        found = f"only one line, of {len(lines[kept[0] - 1])} characters" if kept else "the file is empty"
        raise LogError(f"{path}: {found}; expected a header and lines of numbers separated by '{delimiter}'")
    cells = [[cell.strip() for cell in lines[number - 1].split(delimiter)] for number in kept]
    header, rows = cells[0], cells[_HEADER_LINES:]
    cut = next((row for row, line in enumerate(rows) if len(line) < len(header)), None)
    if cut is not None:
        raise LogError(
            f"{path}: line {kept[cut + _HEADER_LINES]} has {len(rows[cut])} cells, the header {len(header)}; "
            f"the file is cut or not separated by '{delimiter}'; copy it again or remove the line"
        )
    return CsvTable(str(path), header, rows, kept[_HEADER_LINES:])


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
