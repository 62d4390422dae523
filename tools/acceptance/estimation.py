"""Promises about the estimators, from the records of ``calibrator experiment all --out``."""

from collections.abc import Iterator
from pathlib import Path

from acceptance.row import MissingFigureError, Promise, at_least, at_most
from calibrator.experiments.result import ExperimentResult, Row, decode_result

__all__ = ["estimation_promises"]

POSTERIOR, TREE, PERFECT = "posterior", "published/tree", "published/perfect"
SPARSITIES = (20.0, 40.0, 60.0, 80.0)
LARGE, SMALL = "K=2, 5-25 %", ("K=2, 2-10 %", "K=2, 1-5 %", "K=2, 0.5-2 %")
LOADED, THREE = "K=2, 5-25 %, load 3+-1 A", "K=3, 5-25 %"
SURE = 0.95


def estimation_promises(folder: Path) -> Iterator[Promise]:
    """Judge the records in a folder; MissingFigureError if one is not there."""
    names = ("classifier", "sparsity", "statespace", "asymmetry", "real", "delay", "calibration")
    results = {name: _read(folder / f"{name}.json") for name in names}
    yield from _published(results)
    yield from _default(results)
    yield from _recorded(results)
    yield from _honest(results)


def _read(path: Path) -> ExperimentResult:
    if not path.exists():
        raise MissingFigureError(f"{path}: not there")
    return decode_result(path.read_bytes(), str(path))


def _figures(result: ExperimentResult, figure: str, *points: tuple[float, str], method: str = POSTERIOR) -> list[float]:
    try:
        return [result.row(x=x, series=series, method=method).figures[figure].mean for x, series in points]
    except KeyError as error:
        raise MissingFigureError(f"{result.name}: {error}") from None


def _recovered(result: ExperimentResult, *points: tuple[float, str], method: str = POSTERIOR) -> list[float]:
    return _figures(result, "recovery_rate", *points, method=method)


def _published(results: dict[str, ExperimentResult]) -> Iterator[Promise]:
    what = "paper's set-up, published method"
    table = results["classifier"]
    recovered = [*_recovered(table, (60.0, ""), method=TREE), *_recovered(table, (60.0, ""), method=PERFECT)]
    yield at_least(f"{what}, S = 60: tree / perfect classifier", (0.86, 0.90), recovered)
    yield at_least(f"{what}: f2 of the tree", (0.84,), _figures(table, "f2", (60.0, ""), method=TREE))
    yield at_least(f"{what}, S = 80, tree", (0.96,), _recovered(results["sparsity"], (80.0, ""), method=TREE))


def _default(results: dict[str, ExperimentResult]) -> Iterator[Promise]:
    points = [(sparsity, "") for sparsity in SPARSITIES]
    bars = (0.55, 0.69, 0.93, 0.995)
    yield at_least("artificial, S = 20 / 40 / 60 / 80", bars, _recovered(results["sparsity"], *points))
    bars = (0.52, 0.65, 0.91, 0.99)
    yield at_least("state-space, S = 20 / 40 / 60 / 80", bars, _recovered(results["statespace"], *points))
    for bias in ("0", "0.4"):
        sizes = [(size, bias) for size in (20.0, 100.0, 2000.0)]
        what = f"asymmetric fleet, sign bias {bias}, N = 20 / 100 / 2000"
        yield at_least(what, (0.90, 0.92, 0.93), _recovered(results["asymmetry"], *sizes))


def _recorded(results: dict[str, ExperimentResult]) -> Iterator[Promise]:
    real, delay = results["real"], results["delay"]
    yield at_least("real trips, K = 2, S = 80 / 60", (0.99, 0.90), _recovered(real, (80.0, LARGE), (60.0, LARGE)))
    yield at_least("real trips, K = 3, S = 80 / 60", (0.96, 0.79), _recovered(real, (80.0, THREE), (60.0, THREE)))
    small = _recovered(real, *((80.0, series) for series in SMALL))
    yield at_least("real trips, faults of 2 to 10 / 1 to 5 / 0.5 to 2 %", (0.98, 0.97, 0.93), small)
    loaded = _recovered(real, (80.0, LOADED), (60.0, LOADED))
    yield at_least("real trips, unmeasured load of 3 +- 1 A, S = 80 / 60", (0.96, 0.85), loaded)
    error_ms = _figures(delay, "delay_rmse_ms", *((x, "") for x in (100.0, 200.0, 300.0)))
    yield at_most("delays to 300 ms: error", (5.0,), (max(error_ms),), unit="ms")
    without, *delayed = _recovered(delay, *((x, "") for x in (0.0, 100.0, 200.0, 300.0)))
    yield at_most("delays to 300 ms: loss of recovery", (0.01,), (max(without - found for found in delayed),))
    yield at_most("real trips, K = 2, S = 80: harmed", (0.001,), _figures(real, "harmed", (80.0, LARGE)))
    yield at_least("real trips, K = 2, S = 80: deployed", (0.93,), _figures(real, "deployed", (80.0, LARGE)))


def _honest(results: dict[str, ExperimentResult]) -> Iterator[Promise]:
    for name in ("sparsity", "statespace", "asymmetry", "real", "delay"):
        rows = [row for row in results[name].rows if row.method == POSTERIOR]
        yield _sure_are_right(name, [row for row in rows if row.figures["sure"].mean > 0.0])
    for name in ("sparsity", "statespace", "asymmetry", "real", "delay", "all together"):
        ece = [row.figures["ece"].mean for row in results["calibration"].rows if row.series == name]
        if len(ece) != 1:
            raise MissingFigureError(f"calibration: {len(ece)} rows of {name}, one is expected")
        yield at_most(f"honesty, {name}: expected calibration error", (0.02,), ece)


def _sure_are_right(name: str, rows: list[Row]) -> Promise:
    """Of the vehicles above 0.95 as many are right as they say, less 0.01, in every setting."""
    found = [(row.figures["sure_recovered"].mean, row.figures["sure_confidence"].mean, row) for row in rows]
    right, said, worst = min(found, key=lambda item: item[0] - item[1])
    return Promise(
        what=f"honesty, {name}: vehicles above {SURE} that are recovered",
        bar="at least their confidence less 0.01, everywhere",
        figure=f"at worst {right:.3f} at {said:.3f} (x = {worst.x:g} {worst.series})".replace(" )", ")"),
        met=right >= said - 0.01,
    )
