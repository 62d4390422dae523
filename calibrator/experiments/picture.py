"""Results of experiments as pictures: each kind of experiment has its drawing."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calibrator.experiments.picture_bars import draw_bars
from calibrator.experiments.picture_lines import draw_lines
from calibrator.experiments.picture_phase import draw_phase
from calibrator.experiments.picture_reliability import draw_reliability
from calibrator.experiments.result import ExperimentResult

__all__ = ["draw_result", "write_picture"]


def write_picture(result: ExperimentResult, path: Path) -> None:
    """Draw a result into a PNG file.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    path : Path
        PNG file to write.
    """
    draw_result(result).savefig(path, dpi=110)


def draw_result(result: ExperimentResult) -> Figure:
    """Draw a result; error bars are standard deviations over repetitions, rings are the paper's figures.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.

    Returns
    -------
    matplotlib.figure.Figure
        With a legend beside the data.
    """
    drawings = {"phase": draw_phase, "calibration": draw_reliability, "real": draw_bars, "classifier": draw_bars}
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(result.title)
    drawings.get(result.name, draw_lines)(figure, result)
    return figure
