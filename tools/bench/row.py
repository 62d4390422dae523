"""One figure of the benchmarks, beside that of its peer in the same run."""

from dataclasses import dataclass

__all__ = ["Row"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table and of ``build/bench.json``.

    Attributes
    ----------
    name : str
        What was measured.
    value : float
        Figure.
    unit : str
        Of the figure; "1" for a pure number.
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
