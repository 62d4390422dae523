"""Is the confidence honest: of the vehicles with a confidence of 0.9, is a share of 0.9 recovered?"""

from collections.abc import Hashable, Iterable, Sequence

from calibrator.errors import FleetError
from calibrator.experiments.methods import POSTERIOR
from calibrator.experiments.outcome import BINS, calibration_figures
from calibrator.experiments.result import Bin, ExperimentResult, Figure, Row, share

__all__ = ["ALL", "CALIBRATION", "pool_confidences", "pooled_bins", "pooled_share"]

CALIBRATION = "calibration"
ALL = "all together"
NOT_POOLED = (CALIBRATION, "attacks")
"""Attacks are worlds that the estimator does not expect; what becomes of confidences there is in their own table."""


def pool_confidences(results: Sequence[ExperimentResult]) -> ExperimentResult:
    """Pool the confidences of the default method over experiments.

    Experiments share settings, such as the paper's with S = 60, and with the same seed these are the same trials. "All
    together" counts them once: trials are taken for the same if drive, seed, repetitions, bins and figures are.

    Parameters
    ----------
    results : sequence of ExperimentResult
        Of other experiments; those in which the default has no confidence add nothing.

    Returns
    -------
    ExperimentResult
        One row per experiment, and one of all together; x is the number of vehicles.

    Raises
    ------
    FleetError
        If no experiment has a confidence.
    """
    used = {
        result.name: (result, rows)
        for result in results
        if result.name not in NOT_POOLED
        and (rows := [row for row in result.rows if row.method == POSTERIOR.name and row.bins])
    }
    if not used:
        raise FleetError("no experiment has a confidence to check; run 'calibrator experiment all --out FOLDER' first")
    together: dict[Hashable, Row] = {}
    for result, rows in used.values():
        drawn = tuple(result.settings.get(name) for name in ("drive", "seed", "repetitions"))
        for row in rows:
            figures = tuple(sorted((name, figure.mean, figure.sd) for name, figure in row.figures.items()))
            together[drawn, row.bins, figures] = row

    def settings(name: str) -> str:
        return " or ".join(sorted({str(result.settings.get(name, "?")) for result, _ in used.values()}))

    return ExperimentResult(
        name=CALIBRATION,
        title="Reliability of the confidence",
        x_label="vehicles",
        series_label="experiment",
        settings={
            "experiments": ", ".join(used),
            "repetitions": settings("repetitions"),
            "seed": settings("seed"),
            "drive": "those of the experiments",
        },
        rows=(*(_row(name, rows) for name, (_, rows) in used.items()), _row(ALL, [*together.values()])),
    )


def _row(name: str, rows: Sequence[Row]) -> Row:
    bins = pooled_bins(rows)
    vehicles = sum(b.count for b in bins)
    counts = [row.figures["sure"].mean * sum(b.count for b in row.bins) for row in rows]
    figures = {
        "recovery_rate": share(round(sum(b.count * b.recovered for b in bins)), vehicles),
        "confidence": Figure(mean=sum(b.count * b.confidence for b in bins) / vehicles),
        "sure": Figure(mean=sum(counts) / vehicles),
        **calibration_figures(bins),
    }
    for figure in ("sure_confidence", "sure_recovered") if sum(counts) else ():
        weighed = sum(n * row.figures[figure].mean for n, row in zip(counts, rows, strict=True) if n)
        figures[figure] = Figure(mean=weighed / sum(counts))
    if wrong := pooled_share(rows, "sure_wrong"):
        figures["sure_wrong"] = wrong
    return Row(x=vehicles, series=name, method=POSTERIOR.name, figures=figures, bins=bins)


def pooled_bins(rows: Iterable[Row]) -> tuple[Bin, ...]:
    """Bins of several rows together."""
    bins = [b for row in rows for b in row.bins]
    found = []
    for low in (k / BINS for k in range(BINS)):
        same = [b for b in bins if b.low == low]
        count = sum(b.count for b in same)
        if count:
            confidence = sum(b.count * b.confidence for b in same) / count
            recovered = sum(b.count * b.recovered for b in same) / count
            found.append(Bin(low=low, count=count, confidence=confidence, recovered=recovered))
    return tuple(found)


def pooled_share(rows: Iterable[Row], name: str) -> Figure | None:
    """A share over several rows together; None if they do not count it, as in records of before version 2."""
    figures = [row.figures[name] for row in rows if name in row.figures]
    of = sum(figure.of or 0 for figure in figures)
    known = [figure.expected for figure in figures if figure.expected is not None]
    return share(sum(figure.hits or 0 for figure in figures), of, sum(known) if known else None) if of else None
