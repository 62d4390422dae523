"""The bars of a release, limits that its figures must meet (``bars.toml``), beside the figures that were measured.

    python -m bench.bars        (in tools/, after experiments and benchmarks)

Fails if a bar has no figure, or is missed by more than ``bars.toml`` says is known; or if figures are of more than one
commit, or of changed files.
"""

import json
import operator
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import typer
from scipy.stats import binomtest

__all__ = ["Bars", "main"]

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).parent / "bars.toml"
COMPARISONS = {"<=": (operator.le, max), ">=": (operator.ge, min)}
"""How a figure is compared with a bar, and which of several rows is farthest from it."""


def meets(value: float, bar: str) -> bool:
    """Check whether a figure meets a bar such as ``<= 3``; NaN never does."""
    sign, limit = bar.split()
    return bool(COMPARISONS[sign][0](value, float(limit)))


class Bars:
    """Looks up the figures of experiments and benchmarks that bars limit.

    Parameters
    ----------
    bench : Path
        Rows of the benchmarks, ``build/bench.json``.
    results : Path
        Folder of the results of experiments, ``docs/results``.
    """

    def __init__(self, bench: Path, results: Path) -> None:
        self.bench, self.results = bench, results
        self.made: set[str] = set()
        """Commits of the figures that were looked up."""

    def figure(  # noqa: PLR0911 (each figure has its own rule)
        self, where: str, rows: str, figure: str, bar: str
    ) -> tuple[float, str]:
        """Return the figure of a row of ``bars.toml``, NaN if it was not measured, and what is behind it as text.

        The row gives the experiment or "bench" (``where``), a pattern of names of ``rows``, the figure, and its bar. Of
        several rows shares are pooled; other figures, and "each SHARE", are those of the row farthest from the bar. The
        text has counts, for pooled shares also the 95 % interval; for benchmarks it is empty.
        """
        worst = COMPARISONS[bar.split(maxsplit=1)[0]][1]
        if where == "bench":
            return self._benchmark(rows, figure, worst), ""
        result = json.loads((self.results / f"{where}.json").read_text())
        self.made.add(commit(result["made"]))
        table = pd.DataFrame(result["figures"])
        table = table.dropna(subset="x")  # all settings together are a row of their own
        table["row"] = table["series"] + ", " + table["x"].map("{:g}".format)
        table = table[table["row"].str.fullmatch(rows)]
        values, cases = (
            table.pivot_table(index="row", columns=["method", "figure"], values=of) for of in ("value", "of")
        )
        if values.empty:
            return np.nan, ""
        value, of = values["posterior"], cases["posterior"]
        if figure == "below_prior_known":
            return float((values["posterior/prior known"] - value)["recovery_rate"].max()), ""
        if figure == "ece_beyond_chance":
            return float((value["ece"] - value["ece_by_chance"]).max()), ""
        if figure == "of_expected":
            wrong, expected = (
                float((share * of["sure_wrong"]).sum()) for share in (value["sure_wrong"], 1 - value["sure_confidence"])
            )
            return wrong / expected, f"{wrong:.0f}, {expected:.1f} expected"
        figure, each = figure.removeprefix("each "), figure.startswith("each ")
        if each:
            share = value[figure]
            row = share.idxmin() if worst is min else share.idxmax()
            return float(share[row]), f"{row}: {round(share[row] * of[figure][row])} of {of[figure][row]:.0f}"
        count, number = round(float((value[figure] * of[figure]).sum())), int(of[figure].sum())
        interval = binomtest(count, number).proportion_ci()
        return count / number, f"{count} of {number}, {interval.low:.4f} to {interval.high:.4f}"

    def _benchmark(self, rows: str, figure: str, worst: Callable[["pd.Series[float]"], float]) -> float:
        """Return the figure of a benchmark; NaN if it was not measured."""
        measured = pd.DataFrame(json.loads(self.bench.read_text()))
        found = measured[measured["name"].str.fullmatch(rows)]
        self.made.update(map(commit, found["made"]))
        return float(worst(found[figure])) if len(found) else np.nan


def commit(made: str) -> str:
    """Return the commit in what :func:`.made_now` has written; it ends with "-dirty" if files were changed."""
    return made.partition(" of commit ")[2].partition(",")[0] or "unknown"


def main(*, bench: Path = ROOT / "build/bench.json", results: Path = ROOT / "docs/results") -> None:
    """Print each bar with its figure, and whether it is met."""
    bars, missed = Bars(bench, results), 0
    for where, rows, figure, bar, *known in tomllib.loads(LIST.read_text())["bars"]:
        value, behind = bars.figure(where, rows, figure, bar)
        verdict = "met" if meets(value, bar) else "MISSED"
        if verdict == "MISSED" and known and meets(value, known[0]):
            verdict = f"missed ({known[1]})"
        missed += verdict == "MISSED"
        print(f"{where:9} {rows[:48]:48} {figure:17} {bar:8} {value:8.4g}  {verdict:6} {behind}")
    if missed:
        raise SystemExit(f"{missed} bars are missed that were met before, missed by more, or have no figure")
    if len(bars.made) > 1 or any(each.endswith("-dirty") for each in bars.made):
        raise SystemExit(f"figures of {', '.join(sorted(bars.made))}; expected those of one commit, without changes")


if __name__ == "__main__":
    typer.run(main)
