"""Pictures of results: nothing is hidden, cut off or indistinguishable."""

from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calibrator.experiments.experiments import EXPERIMENTS, ExperimentResult
from calibrator.experiments.figures import figure_rows
from calibrator.experiments.methods import PERFECT, POSTERIOR
from calibrator.experiments.pages import draw_result
from calibrator.experiments.runner import pool_confidences

BIASES = ("0", "0.2", "0.4", "0.5")


def shown_as(result: ExperimentResult, name: str) -> ExperimentResult:
    """The same figures, drawn as another experiment."""
    return replace(result, experiment=EXPERIMENTS[name])


@pytest.fixture(scope="module")
def equal() -> ExperimentResult:
    """All series and methods the same, at the ends of the scale, of 30 vehicles each; the default knows it."""
    tables = []
    for series, (x, rate), method in product(BIASES, ((20.0, 0.0), (2000.0, 1.0)), (PERFECT, POSTERIOR)):
        within = np.full(30, rate > 0.0)
        values = {"recovery_rate": within}
        if method is POSTERIOR:
            values |= {"confidence": within + 0.0, "sure": within, "sure_confidence": within[within] + 0.0}
            values |= {"ece": np.column_stack([np.where(within, 0.99, 0.25), within])}
        tables.append([table.assign(series=series, x=x, method=method.name) for table in figure_rows([values])])
    figures, tenths = (pd.concat(some, ignore_index=True) for some in zip(*tables, strict=True))
    return ExperimentResult(experiment=EXPERIMENTS["asymmetry"], settings={"seed": 0}, figures=figures, tenths=tenths)


def drawn(result: ExperimentResult) -> Figure:
    figure = draw_result(result)
    figure.draw_without_rendering()
    return figure


def test_identical_curves_do_not_hide_each_other(equal: ExperimentResult) -> None:
    for axes in drawn(equal).axes:
        curves = [container.lines[0] for container in axes.containers if isinstance(container, ErrorbarContainer)]
        assert len(curves) == len(BIASES)
        for looks in (Line2D.get_color, Line2D.get_marker, Line2D.get_linestyle):
            assert len({looks(curve) for curve in curves}) == len(BIASES)
        places = axes.transData.transform(np.concatenate([np.asarray(curve.get_xydata())[:1] for curve in curves]))
        assert np.all(np.diff(places[:, 0]) > 5.0)


def test_error_bars_are_the_95_percent_intervals(equal: ExperimentResult) -> None:
    single = replace(equal, figures=equal.figures.query("series == '0'").assign(series=""))
    for result, across in ((equal, 1), (shown_as(single, "snr"), 1), (shown_as(equal, "real"), 0)):
        axes = drawn(result).axes[0]
        lines = [c for c in axes.collections if isinstance(c, LineCollection)]
        ends = np.concatenate([np.ravel([s[:, across] for s in line.get_segments()]) for line in lines])
        assert {0.0, 0.116, 0.884, 1.0} == {round(float(end), 3) for end in ends}, "of 0 and of 30 of 30 vehicles"


def test_legend_covers_no_data_and_names_each_curve_once(equal: ExperimentResult) -> None:
    for result in (equal, shown_as(equal, "real"), pool_confidences([equal])):
        figure = drawn(result)
        (legend,) = figure.legends
        assert not any(legend.get_window_extent().overlaps(axes.get_window_extent()) for axes in figure.axes)
        names = [text.get_text() for text in legend.get_texts()]
        assert len(names) == len(set(names))
    assert [text.get_text() for text in drawn(equal).legends[0].get_texts()] == [f"sign bias {b}" for b in BIASES]


def test_every_cell_of_a_map_shows_its_rate(equal: ExperimentResult) -> None:
    texts = [text.get_text() for text in drawn(shown_as(equal, "phase")).axes[0].texts]
    assert sorted(texts) == ["0.00"] * len(BIASES) + ["1.00"] * len(BIASES)
