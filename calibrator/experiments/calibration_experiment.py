"""Is the confidence honest: of the vehicles with a confidence of 0.9, is a share of 0.9 recovered?"""

from collections.abc import Hashable, Iterable, Sequence

from calibrator.errors import FleetError
from calibrator.experiments.methods import POSTERIOR
from calibrator.experiments.outcome import BINS, calibration_figures
from calibrator.experiments.result import Bin, ExperimentResult, Figure, Row, share

__all__ = ["ALL", "NOT_POOLED", "calibration_experiment", "pooled_bins", "pooled_share"]

ALL = "all together"
NAME = "calibration"
NOT_POOLED = (NAME, "attacks")
"""Attacks are worlds that the estimator does not expect; what becomes of confidences there is in their own table."""


def calibration_experiment(results: Sequence[ExperimentResult]) -> ExperimentResult:
    """Pool the confidences of the default method over experiments.

    Experiments share settings, such as the paper's with S = 60, and with the same seed these are the same trials: the
    same vehicles, of which two records tell no more than one. All together counts them once. Trials are taken for the
    same if drive, seed and repetitions are, and all bins and figures agree to the last digit, which means of
    confidences do not do by chance. The same faults seen otherwise (through other noise, with another method) are
    other trials.

    Parameters
    ----------
    results : sequence of ExperimentResult
        Of other experiments; those in which the default has no confidence add nothing.

    Returns
    -------
    ExperimentResult
        One row per experiment, and one of all together; x is the number of vehicles, each trial counted once.

    Raises
    ------
    FleetError
        If no experiment has a confidence.
    """
    rows_by_name = {
        result.name: [row for row in result.rows if row.method == POSTERIOR.name and row.bins]
        for result in results
        if result.name not in NOT_POOLED
    }
    used = {name: rows for name, rows in rows_by_name.items() if rows}
    if not used:
        raise FleetError("no experiment has a confidence to check; run 'calibrator experiment all --out FOLDER' first")
    together = {_trials(result, row): row for result in results for row in used.get(result.name, ())}
    repetitions = {str(result.settings.get("repetitions", "?")) for result in results if result.name in used}
    return ExperimentResult(
        name=NAME,
        title="Reliability of the confidence",
        x_label="vehicles",
        series_label="experiment",
        settings={
            "experiments": ", ".join(used),
            "repetitions": " or ".join(sorted(repetitions)),
            "seed": " or ".join(sorted({str(r.settings.get("seed", "?")) for r in results if r.name in used})),
            "drive": "those of the experiments",
        },
        rows=tuple(_row(name, rows) for name, rows in {**used, ALL: list(together.values())}.items()),
    )


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


def _trials(result: ExperimentResult, row: Row) -> Hashable:
    """Key that is the same for the same trials."""
    drawn = tuple(result.settings.get(name) for name in ("drive", "seed", "repetitions"))
    figures = tuple(sorted((name, figure.mean, figure.sd) for name, figure in row.figures.items()))
    return drawn, row.bins, figures


def _row(name: str, rows: Sequence[Row]) -> Row:
    bins = pooled_bins(rows)
    vehicles = sum(b.count for b in bins)
    figures = {
        "recovery_rate": Figure(mean=sum(b.count * b.recovered for b in bins) / vehicles),
        "confidence": Figure(mean=sum(b.count * b.confidence for b in bins) / vehicles),
        **_sure(rows, vehicles),
        **calibration_figures(bins),
    }
    wrong = pooled_share(rows, "sure_wrong")
    return Row(
        x=vehicles,
        series=name,
        method=POSTERIOR.name,
        figures=figures if wrong is None else {**figures, "sure_wrong": wrong},
        bins=bins,
    )


def pooled_share(rows: Iterable[Row], name: str) -> Figure | None:
    """A share over several rows together; None if they do not count it, as in records of before version 2."""
    figures = [row.figures[name] for row in rows if name in row.figures]
    of = sum(figure.of or 0 for figure in figures)
    known = [figure.expected for figure in figures if figure.expected is not None]
    return share(sum(figure.hits or 0 for figure in figures), of, sum(known) if known else None) if of else None


def _sure(rows: Sequence[Row], vehicles: int) -> dict[str, Figure]:
    """Share of vehicles above 0.95, their mean confidence and the share of them that is recovered."""
    counts = [row.figures["sure"].mean * sum(b.count for b in row.bins) for row in rows]
    total = sum(counts)
    if not total:
        return {"sure": Figure(mean=0.0)}

    def mean(name: str) -> Figure:
        return Figure(mean=sum(n * row.figures[name].mean for n, row in zip(counts, rows, strict=True) if n) / total)

    return {
        "sure": Figure(mean=total / vehicles),
        "sure_confidence": mean("sure_confidence"),
        "sure_recovered": mean("sure_recovered"),
    }
