"""Read tables of measured values: CSV and other text, Parquet, Feather, decoded MF4. One column is the time.

The user need not describe a file: delimiter, decimal sign, encoding, header, units and the time column are detected,
and ``Table.found`` says what was detected. Rows need not have a value in every column.
"""

import csv
import difflib
import io
import itertools
import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from calibrator.drive import LARGEST, Array, Mask
from calibrator.drives.charge import GAP_PERIODS
from calibrator.errors import LogError
from calibrator.files.layout_files import check_formulas
from calibrator.recordings.frame_arrays import LATEST_TIME_STAMP_NS, repaired_time
from calibrator.recordings.log_files import (
    UNREADABLE,
    exists,
    open_log,
    read_rows,
    readable,
    reason_of,
    suffix_of,
    text_head,
)
from calibrator.recordings.log_formats import logs_in
from calibrator.recordings.mf4 import read_mf4_table
from ecu_node.core.signals import AMPERE, usual_unit
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import LayoutError
from ecu_node.layout import layout_of

__all__ = ["Table", "bare_name", "layout_from_branches", "likely_full_scale_a", "peak_of", "read_table"]

MOST_SHARING = 1.5
"""The time is too coarse if more rows than this, on average, share one instant: loggers repeat a few instants. [1]"""
_DELIMITERS = ("\t", ";", "|", ",", " ")
"""Tried in this order: a comma may be the decimal sign, and a blank may be part of a date."""
_EMPTY = frozenset(("", "-", "--", "nan", "na", "n/a", "#n/a", "null", "none"))
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_SIGNS = {"[\N{MINUS SIGN}\N{EN DASH}](?=[\\d.,])": "-", "(?<=\\d)['\N{RIGHT SINGLE QUOTATION MARK}](?=\\d{3})": ""}
"""Patterns in numbers of spreadsheets, and what to read in their place: a typographic minus, Swiss thousands."""
_THOUSANDS = r"[-+]?[1-9]\d{{0,2}}({0}\d{{3}})+"
"""A whole number with separators of thousands, to be formatted with the separator."""
_LIKE_NUMBER = r"[-+.,(]?\d[^#]*"
"""Beginning of a number, and its rest: ``20.9-``, ``(20.9)``, ``20.9 A``; 1.#QNAN is the NaN of some C programs."""
MOST_UNREAD = 1e-3
"""Largest share of cells like numbers, beside one, that are left out as damaged; with more a column is not read. [1]"""
_UNIT_BEHIND = re.compile(r"(.*\S)\s*[\[({<]([^\])}>]*)[\])}>]")
_UNIT_SUFFIX = re.compile(r"(.*\w)\s*[_/, ]\s*(\w+)")
_SUFFIXES = frozenset(["mA", "A", "kA", "mV", "V", "kV", "W", "kW", "ms", "us", "ns", "s"])
_TIME_WORD = re.compile(
    r"(?:^|[\W_])(t|time|timestamps?|stamp|date|datetime|zeit|zeitstempel|datum|uhrzeit|temps|fecha|tiempo|tijd|elapsed|utc"
    r"|epoch|seconds|secs?|millis)(?:[\W_]|$)"
)
_TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "minutes"), 60.0),
    **dict.fromkeys(("h", "hours"), 3600.0),
}
_SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Least numbers that are times since 1970 in this unit; in the next larger unit they would be absurd dates."""
_LONG_STEPS = ((5000.0, "us"), (5.0, "ms"))
"""Units of times that are whole numbers without a unit: the first whose bound their median step reaches, else seconds.

The bounds rest on tables with up to 200 rows a second, or one every few seconds. Steps below 100 count as milliseconds
only if the table is then not shorter than :data:`_SHORTEST_S`.
"""
_SHORTEST_S = 60.0
ON_OFF = "on/off"
"""Unit given to a column of true and false, so that it is not taken for a current."""
HEADROOM = 2.0
"""Guessed full scale over the recorded peak: a drive hardly ever reaches the nominal maximum current. [1]"""
ROUND = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table in the order of time.

    Attributes
    ----------
    path : Path
        The file.
    time_s : ndarray of shape (n,)
        Time since the first row, not decreasing. [s]
    columns : dict of str to ndarray of shape (n,)
        Numbers by header, as the header is written in the file; NaN where a row has no number.
    units : dict of str to str
        Unit by header, where it has one: ``A`` for ``Ibat [A]``, ``Ibat (Amps)`` or ``Ibat_A``.
    bad : dict of str to ndarray of bool, shape (n,)
        Rows in which a column has a text or an infinite number instead of a number; columns without such rows are
        absent.
    texts : dict of str to str
        By header of each column that is not read, as it has no number or one that cannot be read such as ``20.9-``: the
        first such cell and where it stands, for messages.
    words : collection of str
        Headers in ``texts`` of columns in which no cell is like a number.
    found : str
        What was detected about the file, in words, such as ``decimal ',', utf-8-sig; time 'Zeit' in s``.
    disordered, clock_steps, without_time : int
        Rows that came after a later one and were sorted; steps of the clock that became gaps; rows left out because
        they have no time or more cells than the header.
    """

    path: Path
    time_s: Array
    columns: dict[str, Array]
    units: dict[str, str]
    bad: dict[str, Mask] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    words: Collection[str] = ()
    found: str = ""
    disordered: int = 0
    clock_steps: int = 0
    without_time: int = 0

    def header(self, name: str) -> str | None:
        """Return the header of the column that a name stands for; None if there is none, LogError if several fit.

        The name needs no unit, and either may lack the message: ``Ibat`` stands for ``BMS.Ibat [A]``, ``BMS.Ibat`` for
        ``Ibat [A]``. A header that equals the name comes first.
        """
        return self._same(name, self.columns)

    def _same(self, name: str, headers: Iterable[str]) -> str | None:
        bare = {header: bare_name(header) for header in headers}
        whole = name.rpartition(":")[2]
        for same in (
            [header for header in bare if header == name],
            [header for header, text in bare.items() if text == whole],
            [header for header, text in bare.items() if re.fullmatch(rf"{re.escape(bare_name(whole))}\.\d+", text)],
            [header for header, text in bare.items() if text.endswith(f".{whole}")],
            [header for header, text in bare.items() if text == whole.rpartition(".")[2]],
            [header for header, text in bare.items() if text.casefold() == whole.casefold()],
        ):
            if len(same) > 1:
                raise LogError(f"{self.path}: {name!r} stands for {', '.join(map(repr, same))}; write it in full")
            if same:
                return same[0]
        return None

    def column(self, name: str) -> str:
        """Return the header as :meth:`header` does; raise :class:`LogError` with the known columns if none fits."""
        header = self.header(name)
        if header is None:
            why = "; ".join(self.no_numbers(name) or (f"there is no column {name!r}", self.known(name)))
            raise LogError(f"{self.path}: {why}")
        return header

    def no_numbers(self, name: str, *, or_words: bool = True) -> tuple[str, ...]:
        """Return the complaint about a column that is not read, and what to do; empty for all other columns.

        Without ``or_words`` it is empty for :attr:`words`, too.
        """
        header = None if self.header(name) is not None else self._same(name, self.texts)
        if header is None or (header in self.words and not or_words):
            return ()
        return f"column {header!r}: {self.texts[header]}", "write numbers, and the unit in the header"

    def known(self, name: str = "") -> str:
        """List the columns as part of a message, those similar to `name` first."""
        like = difflib.get_close_matches(name, self.columns, n=3, cutoff=0.5)
        names = list(dict.fromkeys([*like, *self.columns]))
        more = f" and {len(names) - 12} more" if len(names) > 12 else ""
        return f"the columns are {', '.join(map(repr, names[:12]))}{more}"


def bare_name(header: str) -> str:
    """Return the header of a column without its unit: ``Ibat`` for ``Ibat [A]``."""
    return _name_and_unit(header)[0]


def _name_and_unit(header: str) -> tuple[str, str]:
    header = header.strip()
    if found := _UNIT_BEHIND.fullmatch(header):
        return found[1], usual_unit(found[2])
    if (found := _UNIT_SUFFIX.fullmatch(header)) and found[2] in _SUFFIXES:
        return found[1], found[2]
    return header, ""


def read_table(path: Path) -> Table:
    """Read a table of measured values, and detect how it is written.

    Parameters
    ----------
    path : Path
        The file, or a folder or archive with this table only; text may be gzipped.

    Returns
    -------
    Table
        The time, and all other columns that hold numbers.

    Raises
    ------
    LogError
        If the file cannot be read, has no header, fewer than two rows, no time or no other numbers.
    """
    files = logs_in(path)
    if len(files) == 1:
        return read_table(files[0])
    if files:
        raise LogError(f"{path}: {len(files)} tables in it; give one table, or import the folder as drives")
    if not exists(path):
        what = "no table in it" if path.is_dir() else "no such file"
        raise LogError(f"{path}: {what}; give a table that is there")
    units: dict[str, str] = {}
    found = ""
    try:
        with readable(path) as file:
            match suffix_of(path):
                case ".parquet":
                    frame = pd.read_parquet(file)
                case ".feather" | ".arrow":
                    frame = pd.read_feather(file)
                case ".mf4":
                    frame, units = read_mf4_table(file)
                case _:
                    frame, units, found = _read_text(file)
    except (
        *UNREADABLE,
        pa.ArrowException,
        pd.errors.ParserError,
        pd.errors.EmptyDataError,
        UnicodeError,
        json.JSONDecodeError,
    ) as error:
        raise LogError(f"{path}: not a readable table: {reason_of(error)[:200]}; save or copy it again") from None
    frame = _index_as_columns(frame)
    if len(frame) < 2:
        raise LogError(f"{path}: {len(frame)} rows of values; a header and at least two rows are expected")
    return _table(path, frame, units, found)


def _index_as_columns(frame: pd.DataFrame) -> pd.DataFrame:
    """Turn the index of a data frame into columns, and make its headers distinct.

    An index without a name may be the time, or only row numbers that a filter has left. It becomes the last column, so
    that any column that is called time is tried before it.
    """
    index, frame = frame.index, frame.reset_index(drop=True)
    if any(name is not None for name in index.names):
        frame = pd.concat([index.to_frame(index=False), frame], axis=1)
    elif not isinstance(index, pd.RangeIndex) and "time" not in frame:
        frame = frame.assign(time=index)
    return frame.set_axis(_distinct(list(map(str, frame.columns))), axis=1)


def layout_from_branches(text: str, *, table: Table | None = None) -> VehicleDatabase:
    """Make a layout for a table from the text of the option ``--branches``.

    Parameters
    ----------
    text : str
        Branches separated by commas, as ``battery=Ibat,-motor=Imot``: name and column, or the column alone. A minus
        marks a current that is positive out of the junction. With a table, an item that is no column and contains
        ``+ - * /``, such as ``-motor=Pmot/Ubat``, is a formula. [A]
    table : Table, optional
        The table, from which full scale and time-outs are taken, and in which the columns must exist.

    Returns
    -------
    VehicleDatabase
        The layout, which is in no file, without a DBC.

    Raises
    ------
    LayoutError
        If the text does not name two branches or more, or a formula cannot be evaluated.
    LogError
        If the table has no such column.
    """
    branches: list[dict[str, Any]] = []
    for place, item in enumerate(filter(None, map(str.strip, text.split(","))), start=1):
        name, _, column = (part.strip() for part in item.rpartition("="))
        is_out = name.startswith("-") or column.startswith("-")
        column = column.removeprefix("-").strip()
        words = re.findall(r"[A-Za-z0-9]+", name) or re.findall(r"[A-Za-z0-9]+", bare_name(column)) or [f"b{place}"]
        is_column = table is None or table.header(column) is not None or not re.search(r"[-+*/]", column)
        branch: dict[str, Any] = {"name": re.sub(r"^(?=\d)", "_", "_".join(words)), "sign": -1 if is_out else 1}
        branches.append({**branch, "signal" if is_column else "formula": column})
    if len(branches) < 2:
        raise LayoutError(f"--branches {text}: two or more are expected, such as battery=Ibat,-motor=Imot")
    keys: dict[str, Any] = {"schema": 1, "name": "table", "branch": branches, "full_scale_a": 1.0}
    if table is not None:
        columns = {item["name"]: table.column(item["signal"]) for item in branches if "signal" in item}
        periods_s = {name: _period_s(table.time_s[np.isfinite(table.columns[c])]) for name, c in columns.items()}
        factors = {name: AMPERE.get(table.units.get(column, "A"), 1.0) for name, column in columns.items()}
        peaks_a = [
            factors[name] * peak_of(table.columns[c][np.isfinite(table.columns[c])]) for name, c in columns.items()
        ]
        keys["full_scale_a"] = likely_full_scale_a(max([*peaks_a, 0.5]))
        longest_s = max(periods_s.values(), default=0.0)
        for branch in branches:
            branch["timeout_s"] = max(0.5, GAP_PERIODS * periods_s.get(branch["name"], longest_s))
    layout = layout_of(keys, Path("--branches"))
    check_formulas(layout)
    return read_database(layout)


def _period_s(time_s: Array) -> float:
    return round(float(np.median(np.diff(time_s))), 3) if len(time_s) > 1 else 0.0


def peak_of(value: Array) -> float:
    """Return the 99.9 % quantile of the magnitude, which ignores wild samples; 0 for no values."""
    return float(np.quantile(np.abs(value), 0.999)) if len(value) else 0.0


def likely_full_scale_a(peak_a: float) -> float:
    """Guess the full scale of a junction: :data:`HEADROOM` times the peak (not 0), rounded up to a round number. [A]"""
    least_a = HEADROOM * peak_a
    decade = 10.0 ** np.floor(np.log10(least_a))
    return float(next(step * decade for step in ROUND if step * decade >= least_a * (1.0 - 1e-9)))


def _table(path: Path, frame: pd.DataFrame, units: dict[str, str], found: str) -> Table:
    units = {name: unit for name in frame if (unit := usual_unit(units.get(name, "")) or _name_and_unit(name)[1])}
    units |= {name: ON_OFF for name in frame if pd.api.types.is_bool_dtype(frame[name])}
    names, time_s, about = _time(path, frame, units)
    known = np.isfinite(time_s)
    known &= np.abs(time_s - np.median(time_s[known])) < 1e-9 * LATEST_TIME_STAMP_NS
    order = repaired_time(np.rint(1e9 * (time_s[known] - time_s[known][0])).astype(np.int64))
    rows = np.flatnonzero(known)[order.order]
    columns, bad, texts, words = {}, {}, {}, list[str]()
    for name in frame.columns.difference(names, sort=False):
        value, is_bad = _numbers(frame[name])
        bad_rows, numbers = np.flatnonzero(is_bad), int(np.isfinite(value).sum())
        cells = frame[name].iloc[bad_rows].astype("string").str.strip()
        unread = bad_rows[cells.str.fullmatch(_LIKE_NUMBER).to_numpy(np.bool_)]
        most = max(1.0, MOST_UNREAD * (numbers + len(bad_rows)))
        if not is_bad.any() or (numbers and len(unread) <= most):
            columns[name] = value[rows]
            if is_bad[rows].any():
                bad[name] = is_bad[rows]
        else:
            row = int((unread if unread.size else bad_rows)[0])
            words += [] if unread.size else [name]
            which = f"{len(bad_rows):,} of its {len(frame):,} cells" if numbers else "its cells"
            line = f"line {frame.attrs['line'] + row}" if "line" in frame.attrs else f"row {row + 1}"
            texts[name] = f"{which} are no numbers, such as {str(frame[name].iloc[row])!r} in {line}"
    if not columns:
        shown = next((f"; '{name}': {text}" for name, text in texts.items()), "")
        raise LogError(f"{path}: no column of numbers beside the time{shown}")
    coarse = _coarse(order.time_s, columns)
    return Table(
        path=path,
        time_s=_spread(order.time_s) if coarse else order.time_s,
        columns=columns,
        units={name: unit for name, unit in units.items() if name in columns},
        bad=bad,
        texts=texts,
        words=words,
        found=f"{found}{about}{coarse}",
        disordered=order.disordered,
        clock_steps=order.clock_steps,
        without_time=int(np.sum(~known)) + frame.attrs.get("left out", 0),
    )


def _coarse(time_s: Array, columns: Mapping[str, Array]) -> str:
    """Return a remark if too many rows of a column share each time; empty otherwise."""
    kept = [time_s[np.isfinite(value)] for value in columns.values()]
    share = max(len(times) / max(len(np.unique(times)), 1) for times in kept)
    what = f"; {share:.3g} rows share each time: write its fractions of a second"
    return f"{what}; until then they count as evenly spread" if share > MOST_SHARING else ""


def _spread(time_s: Array) -> Array:
    """Spread rows that share one time evenly until the next; those of the first time end just before the second."""
    stamps, first, count = np.unique(time_s, return_index=True, return_counts=True)
    if len(stamps) < 2:
        return time_s
    usual_s = float(np.median(np.diff(stamps)) / np.median(count))
    length_s = np.minimum(np.append(np.diff(stamps), np.inf), count * usual_s)
    start_s = stamps + np.append(max(stamps[1] - stamps[0] - count[0] * usual_s, 0.0), np.zeros(len(stamps) - 1))
    place = np.arange(len(time_s)) - np.repeat(first, count)
    return np.asarray(np.repeat(start_s, count) + place * np.repeat(length_s / count, count))


def _numbers(column: "pd.Series[float]") -> tuple[Array, Mask]:
    """Return the numbers of a column, NaN where a cell has none, and which cells hold something else than a number."""
    if pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column):
        value = column.to_numpy(np.float64, na_value=np.nan)
        bad = np.abs(value) > LARGEST
    else:
        text = column.astype("string").str.strip()
        value = pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)
        empty = text.isna() | text.str.lower().isin(_EMPTY)
        bad = ~(np.abs(value) <= LARGEST) & ~empty.to_numpy(np.bool_)
    return np.where(np.abs(value) <= LARGEST, value, np.nan), bad


# ---- time


def _time(path: Path, frame: pd.DataFrame, units: Mapping[str, str]) -> tuple[list[str], Array, str]:
    """Find the time: return the headers of its column or columns, the time [s], and what it was taken for."""
    named = [name for name in frame if _TIME_WORD.search(bare_name(name).lower())]
    for first, second in itertools.pairwise(named):  # a date and the time of day beside it
        if "dat" in first.lower() and not pd.api.types.is_numeric_dtype(frame[second]):
            both, form = _dates(frame[first].astype("string") + " " + frame[second].astype("string"))
            if _increases(both):
                return [first, second], both, f"time '{first}' and '{second}', a {form}"
    falling = False
    for name in dict.fromkeys([*named, *frame.columns]):
        if falling and name not in named:
            break  # rows in descending order: no other column that happens to increase is the time
        time_s, unit = _seconds(frame[name], name, units.get(name, ""))
        falling |= name in named and _increases(-time_s)
        if (name in named or unit.startswith(("date", "time of day")) or not _is_row_number(name)) and _increases(
            time_s
        ):
            return [name], time_s, f"time '{name}' in {unit}" if unit in _TIME_UNITS else f"time '{name}', a {unit}"
    if named:
        raise LogError(f"{path}: the time does not increase in column '{named[0]}'; sort the rows by it")
    raise LogError(
        f"{path}: no column is the time: none has it in its name and increases; expected seconds, ms, us or dates "
        f"under a header such as 'time [s]'; the columns are {', '.join(map(repr, frame.columns[:12]))}"
    )


def _is_row_number(name: str) -> bool:
    return (
        re.fullmatch(r"(unnamed.*|column \d+|index|no\.?|nr\.?|row|sample|samples|count|#|)", name.lower()) is not None
    )


def _increases(time_s: Array) -> bool:
    """Check whether numbers can be instants: most are present, they differ, and they hardly ever decrease."""
    step = np.diff(time_s[np.isfinite(time_s)])
    return len(step) + 1 > 0.5 * len(time_s) and bool((step > 0.0).any()) and float(np.mean(step < 0.0)) < 0.02


def _seconds(column: "pd.Series[float]", name: str, unit: str) -> tuple[Array, str]:
    """Convert a column to seconds, NaN where a cell is no time; return also the unit or form it was taken for."""
    if pd.api.types.is_timedelta64_dtype(column):
        return np.asarray(column.dt.total_seconds()), "duration"
    if pd.api.types.is_datetime64_any_dtype(column):
        return _dates(column)
    value, bad = _numbers(column)
    if bad.mean() > 0.5:
        text = column.astype("string").str.strip()
        of_day = text.str.fullmatch(r"\d+:\d\d(:\d\d([.,]\d+)?)?")
        if bool(of_day.mean() > 0.5):
            minutes = text.str.replace(",", ".").str.replace(r"^(\d+:\d\d)$", r"\1:00", regex=True)
            return np.asarray(pd.to_timedelta(minutes, errors="coerce").dt.total_seconds()), "time of day"
        return _dates(text)
    words = [unit.lower(), *reversed(re.split(r"[\W_]+", name.lower()))]
    known = next((word for word in words if word in _TIME_UNITS), None) or _likely_unit(value[np.isfinite(value)])
    return value * _TIME_UNITS[known], known


def _likely_unit(value: Array) -> str:
    if not value.size:
        return "s"
    for least, unit in _SINCE_1970:
        if np.median(value) >= least:
            return unit
    step = float(np.median(np.abs(np.diff(value)))) if value.size > 1 else 0.0
    if np.any(value != np.rint(value)) or (step < 100.0 and np.ptp(value) < 1e3 * _SHORTEST_S):
        return "s"
    return next((unit for least, unit in _LONG_STEPS if step >= least), "s")


def _dates(column: "pd.Series[str]") -> tuple[Array, str]:
    """Convert dates to seconds since the earliest one; return also their form.

    The day is first in dates with points, as 31.12.2025, and where any first number is above 12; else the month is.
    """
    form = "date"
    if not pd.api.types.is_datetime64_any_dtype(column):
        text = column.astype("string").str.strip().str.replace(r"(:\d\d),(\d)", r"\1.\2", regex=True)
        if not bool(text.str.match(r"\d+[-./]\d").mean() > 0.5):
            return np.full(len(column), np.nan), form
        first = pd.to_numeric(text.str.extract(r"^(\d{1,2})[-./]\d{1,2}[-./]")[0])
        day_first = bool((first > 12).any() or text.str.match(r"\d{1,2}\.\d{1,2}\.").mean() > 0.5)
        if first.notna().any():
            form = f"date, {'day' if day_first else 'month'} first"
        column = pd.to_datetime(text, format="mixed", dayfirst=day_first, utc=True, errors="coerce")
    if column.dt.tz is not None:
        column = column.dt.tz_convert("UTC").dt.tz_localize(None)
    return np.asarray((column - column.min()) / pd.Timedelta(seconds=1), np.float64), form


# ---- text


def _read_text(path: Path) -> tuple[pd.DataFrame, dict[str, str], str]:
    head, encoding = text_head(path)
    if "\0" in head:
        raise LogError(f"{path}: binary data under the name of a text; give the file the suffix of its format")
    if not head.strip():
        raise LogError(f"{path}: the file is empty; a header and rows of numbers are expected")
    for pattern, sign in _SIGNS.items():
        head = re.sub(pattern, sign, head)
    delimiter, rows = _cells(path, head)
    width = _usual_width(rows)
    first = next((k for k, row in enumerate(rows) if len(row) >= width and _has_values(row)), None)
    if first is None:
        raise LogError(f"{path}: no row of numbers below the header; a header and rows of numbers are expected")
    above = [k for k in range(first) if len(rows[k]) >= width - 1]
    if not above:
        raise LogError(f"{path}: no header: line {first + 1} has numbers; write the names of the columns above them")
    units: list[str] = []
    header = rows[above[-1]]
    if len(above) > 1 and above[-2] == above[-1] - 1 and _are_units(header):
        units, header = header, rows[above[-2]]
    names = _distinct([*header, *[""] * (width - len(header))])
    body = [cell for row in rows[first:] for cell in row]
    commas = [cell for cell in body if _DECIMAL_COMMA.fullmatch(cell)]
    points = [cell for cell in body if "." in cell and _NUMBER.fullmatch(cell)]
    only_thousands = [
        all(re.fullmatch(_THOUSANDS.format(sign), cell) for cell in cells)
        for sign, cells in ((",", commas), (r"\.", points))
    ]
    if only_thousands[0] and (points or delimiter != ";"):  # between semicolons, without points, a comma is decimal
        decimal = "."
    elif len(commas) > len(points) or (only_thousands[1] and 10 * len(commas) > len(points)):  # fewer stand in notes
        decimal = ","
    else:
        decimal = "."
    with io.TextIOWrapper(open_log(path), encoding=encoding, errors="replace", newline="") as file:
        separator = r"\s+" if delimiter == " " else delimiter
        frame, left_out = read_rows(
            file, sep=separator, decimal=decimal, skiprows=first, header=None, names=names, low_memory=False
        )
    frame.attrs["left out"] = left_out
    frame = frame.drop(columns=[name for name in names if name not in header and frame[name].isna().all()])
    frame.attrs["line"] = first + 1
    texts = frame.select_dtypes(exclude=["number", "bool"]).astype("string").replace(_SIGNS, regex=True)
    texts = _without_thousands(path, texts, decimal)
    if decimal == ",":  # pandas leaves the comma in columns that hold a text somewhere
        texts = texts.apply(lambda c: c.astype("string").str.replace(r"^([-+\d]*),", r"\1.", regex=True))
    frame[texts.columns] = texts
    shown = {"\t": "tabs", " ": "blanks"}.get(delimiter, f"'{delimiter}'")
    about = f"columns between {shown}, decimal '{decimal}', {encoding}; "
    return frame, {name: usual_unit(unit) for name, unit in zip(names, units, strict=False) if unit}, about


def _without_thousands(path: Path, texts: pd.DataFrame, decimal: str) -> pd.DataFrame:
    """Remove separators of thousands, which cells such as 1,234.5 or 1.234,5 prove, or 980 in a column with 1,234.

    Without a proof 1,234 may have three decimals: with a decimal point it stays as it is, so that it is no number; with
    a decimal comma, where 1.234 would be read as a number, it raises a LogError.
    """
    comma, point = (",", r"\.") if decimal == "." else (r"\.", ",")
    whole, separated, proved = _THOUSANDS.format(comma), dict[str, "pd.Series[str]"](), False
    for name in texts:
        text = texts[name].astype("string").str.strip()
        is_whole = text.str.fullmatch(whole).fillna(value=False)
        has_both = text.str.fullmatch(rf"{whole}{point}\d*").fillna(value=False)
        if has_both.any() or (is_whole.any() and not (text.str.contains(comma) & ~is_whole).any()):
            separated[name] = text.where(is_whole | has_both)
            whole_ones = text[text.str.fullmatch(r"[-+]?[1-9]\d{0,2}").fillna(value=False)]
            proved |= bool(has_both.any() or whole_ones.nunique() > 1)  # a single value may be a code for no value
    if separated and not proved and decimal == ",":
        name, text = next(iter(separated.items()))
        cell = text.dropna().iloc[0]
        raise LogError(
            f"{path}: column {name!r}: {cell!r} may be {cell.replace('.', '')} or {cell.replace('.', ',')}; write it "
            f"without separators of thousands, or with a decimal comma"
        )
    plain = {name: text.str.replace(comma, "", regex=True) for name, text in separated.items() if proved}
    return texts.assign(**{name: text.fillna(texts[name].astype("string")) for name, text in plain.items()})


def _cells(path: Path, head: str) -> tuple[str, list[list[str]]]:
    """Return the delimiter, and the cells of the first lines; raise LogError if these form no table."""
    lines = head.splitlines()
    for delimiter in _DELIMITERS:
        reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
        try:
            rows = [[cell.strip() for cell in row] for row in reader]
        except csv.Error:
            continue
        width = _usual_width(rows)
        if width > 1 and np.mean([len(row) == width for row in rows[len(rows) // 2 :] if row]) > 0.8:
            return delimiter, rows
    found = (
        f"only one line, of {len(lines[0])} characters" if len(lines) == 1 else f"the first line is {lines[0][:60]!r}"
    )
    raise LogError(f"{path}: no table: {found}; columns between commas, semicolons, tabs or blanks are expected")


def _usual_width(rows: Sequence[Sequence[str]]) -> int:
    """Return the most common number of cells in the lower half of the rows, which has no header."""
    return Counter(len(row) for row in rows[len(rows) // 2 :] if row).most_common(1)[0][0] if rows else 0


def _has_values(cells: Sequence[str]) -> bool:
    """Check whether most cells that are not empty begin like a number or a date."""
    filled = [cell for cell in cells if cell.lower() not in _EMPTY]
    return 2 * sum(re.match(r"[-+.,(]?\d", cell) is not None for cell in filled) > len(filled)


def _are_units(cells: Sequence[str]) -> bool:
    units = {"A", "V", "W", "kW", "mA", "mV", "%", "°C", "degC", "km/h", "Nm", "rpm", *_TIME_UNITS}
    known = [cell in {"", "-"} or usual_unit(cell) in units or cell[0] in "[(" for cell in cells]
    return any(cells) and sum(known) >= 0.5 * len(known)


def _distinct(names: Sequence[str]) -> list[str]:
    """Make names non-empty and distinct: equal names get numbers, put before the unit (``I.1 [A]``, ``I.2 [A]``)."""
    filled = [text.strip() or f"column {place}" for place, text in enumerate(names, start=1)]
    total, seen = Counter(filled), Counter[str]()
    result = []
    for name in filled:
        seen[name] += 1
        bare = bare_name(name)
        result.append(name if total[name] == 1 else name.replace(bare, f"{bare}.{seen[name]}", 1))
    return result
