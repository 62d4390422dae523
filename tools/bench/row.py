"""One figure of the benchmarks, beside that of its peer in the same run, and how it is shown."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

__all__ = ["LAYOUT", "MEBIBYTE", "Row", "show"]

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
MEBIBYTE = 1024.0**2


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table and of ``build/bench.json``.

    Attributes
    ----------
    name : str
        What was measured.
    value : float
        Value of the figure.
    unit : str
        Unit of the figure; "1" for a pure number.
    peer : str or None
        What it was compared with in the same run, and the peer's own figure in words.
    ratio : float or None
        How many times better than the peer: its time over ours, or our rate over its.
    """

    name: str
    value: float
    unit: str
    peer: str | None = None
    ratio: float | None = None


def show(rows: Sequence[Row]) -> None:
    """Print rows as a table."""
    table = pd.DataFrame(map(vars, rows)).astype({"ratio": float}).fillna({"peer": ""})
    print(table.to_string(index=False, na_rep="", float_format="{:.4g}".format))
