"""Pictures of results: nothing is hidden, cut off or indistinguishable."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calibrator.drive import Array
from calibrator.experiments.calibration import NOT_POOLED, pool_confidences
from calibrator.experiments.experiments import EXPERIMENTS
from calibrator.experiments.methods import PERFECT, POSTERIOR, TREE
from calibrator.experiments.picture import draw_result
from calibrator.experiments.result import Bin, ExperimentResult, Row
from calibrator.experiments.result import Figure as Merit

BIASES = ("0", "0.2", "0.4", "0.5")


def result_of(*rows: Row, name: str = "asymmetry", series_label: str = "sign bias") -> ExperimentResult:
    return ExperimentResult(
        name=name, title="Title", x_label="vehicles", series_label=series_label, settings={"seed": 0}, rows=rows
    )


def row_of(x: float, method: str, rate: float, series: str = "", paper: float | None = None) -> Row:
    figures = {"recovery_rate": Merit(mean=rate, hits=round(30 * rate), of=30, paper=paper)}
    if method == POSTERIOR.name:
        figures["confidence"] = Merit(mean=rate)
    return Row(x=x, series=series, method=method, figures=figures)


@pytest.fixture
def equal() -> ExperimentResult:
    """All series and methods the same, at the ends of the scale."""
    methods = (PERFECT.name, POSTERIOR.name)
    return result_of(
        *(row_of(x, m, rate, one) for one in BIASES for x, rate in ((20, 0.0), (2000, 1.0)) for m in methods)
    )


def test_a_mean_that_rounding_lifts_over_one_is_drawn() -> None:
    over = float(np.nextafter(1.0, 2.0))
    drawn(result_of(row_of(20, POSTERIOR.name, over), row_of(100, POSTERIOR.name, 1.0)))


def curves_of(axes: Axes) -> list[Line2D]:
    containers = [c for c in axes.containers if isinstance(c, ErrorbarContainer)]
    return [line for container in containers if isinstance(line := container.lines[0], Line2D)]


def on_screen(line: Line2D) -> Array:
    return np.asarray(line.get_transform().transform(line.get_xydata()))


def drawn(result: ExperimentResult) -> Figure:
    figure = draw_result(result)
    figure.draw_without_rendering()
    return figure


def test_equal_curves_stand_side_by_side_inside_the_axes(equal: ExperimentResult) -> None:
    for axes in drawn(equal).axes:
        places = [on_screen(line) for line in curves_of(axes)]
        assert len(places) == len(BIASES)
        for one, other in combinations(places, 2):
            assert np.all(np.abs(one[:, 0] - other[:, 0]) > 5.0)
            np.testing.assert_allclose(one[:, 1], other[:, 1])
        assert all(axes.get_window_extent().contains(*point) for place in places for point in place)


def test_bars_are_the_95_percent_intervals(equal: ExperimentResult) -> None:
    single = replace(equal, name="snr", rows=tuple(replace(r, series="") for r in equal.rows if r.series == "0"))
    for result, across in ((equal, 1), (single, 1), (replace(equal, name="real"), 0)):
        axes = drawn(result).axes[0]
        lines = [c for c in axes.collections if isinstance(c, LineCollection)]
        ends = np.concatenate([np.ravel([s[:, across] for s in line.get_segments()]) for line in lines])
        assert {0.0, 0.116, 0.884, 1.0} == {round(float(end), 3) for end in ends}, "of 0 and of 30 of 30 vehicles"


def test_curves_of_a_panel_differ_in_colour_marker_and_line_style(equal: ExperimentResult) -> None:
    methods = replace(equal, name="sparsity", rows=tuple(row_of(20, m.name, 0.5) for m in (TREE, PERFECT, POSTERIOR)))
    for result, number in ((equal, len(BIASES)), (methods, 3)):
        lines = curves_of(drawn(result).axes[0])
        assert len({line.get_color() for line in lines}) == number
        assert len({line.get_marker() for line in lines}) == number
        assert len({line.get_linestyle() for line in lines}) == number


def test_legend_covers_no_data_and_names_each_curve_once(equal: ExperimentResult) -> None:
    pooled = pool_confidences([_with_bins(equal)])
    for result in (equal, replace(equal, name="real"), pooled):
        figure = drawn(result)
        (legend,) = figure.legends
        assert all(axes.get_legend() is None for axes in figure.axes)
        assert not any(legend.get_window_extent().overlaps(axes.get_window_extent()) for axes in figure.axes)
        names = [text.get_text() for text in legend.get_texts()]
        assert len(names) == len(set(names))
    assert [text.get_text() for text in drawn(equal).legends[0].get_texts()] == list(BIASES)


def test_panels_without_any_figure_are_left_out(equal: ExperimentResult) -> None:
    published = tuple(row for row in equal.rows if row.method == PERFECT.name)
    assert len(drawn(replace(equal, rows=published)).axes) == 1
    assert len(drawn(equal).axes) == 3


@pytest.mark.parametrize("name", ["classifier", "sparsity"])
def test_papers_figure_does_not_hide_ours(name: str) -> None:
    rows = (row_of(60, TREE.name, 0.86, paper=0.86), row_of(60, POSTERIOR.name, 0.9))
    figure = drawn(result_of(*rows, name=name, series_label=""))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert sum(label.startswith("paper, ") for label in labels) == 1
    (paper,) = [c for c in figure.axes[0].collections if str(c.get_label()).startswith("paper, ")]
    assert len(np.asarray(paper.get_facecolor())) == 0


def test_every_experiment_that_can_be_pooled_has_a_colour_and_a_marker_of_its_own(equal: ExperimentResult) -> None:
    results = [replace(_with_bins(equal), name=name, settings={"seed": k}) for k, name in enumerate(EXPERIMENTS)]
    reliability = drawn(pool_confidences(results)).axes[0]
    names = [name for name in EXPERIMENTS if name not in NOT_POOLED]
    labelled = [line for line in reliability.lines if str(line.get_label()).startswith(tuple(names))]
    assert len({line.get_color() for line in labelled}) == len(names)
    assert len({line.get_marker() for line in labelled}) == len(names)


def test_markers_of_few_vehicles_are_hollow(equal: ExperimentResult) -> None:
    reliability = drawn(pool_confidences([_with_bins(equal)])).axes[0]
    faces = {tuple(np.asarray(line.get_xydata())[0]): line.get_markerfacecolor() for line in reliability.lines[1:]
             if len(np.asarray(line.get_xydata())) == 1}  # fmt: skip
    assert faces[0.25, 0.5] == "white"
    assert faces[0.95, 1.0] != "white"


def _with_bins(result: ExperimentResult) -> ExperimentResult:
    bins = (
        Bin(low=0.2, count=2, confidence=0.25, recovered=0.5),
        Bin(low=0.9, count=900, confidence=0.95, recovered=1.0),
    )
    figures = {name: Merit(mean=0.9, sd=0.0) for name in ("recovery_rate", "sure", "sure_confidence", "sure_recovered")}
    rows = tuple(replace(row, bins=bins, figures=figures) for row in result.rows if row.method == POSTERIOR.name)
    return replace(result, rows=rows[:1])
