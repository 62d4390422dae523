"""Results of experiments as pictures."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calibrator.experiments.result import ExperimentResult, Row

__all__ = ["write_picture"]

SHOWN = {"recovery_rate": "recovery rate", "f2": "f2 of hardware faults"}


def write_picture(result: ExperimentResult, path: Path) -> None:
    """Draw recovery rate and f2 over what the experiment varies; crosses are the paper's figures.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    path : Path
        PNG file to write.
    """
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{result.title}; crosses: the paper")
    for axes, (name, label) in zip(figure.subplots(1, len(SHOWN)), SHOWN.items(), strict=True):
        for k, method in enumerate(dict.fromkeys(row.method for row in result.rows)):
            rows = [row for row in result.rows if row.method == method]
            means, sds, papers = _columns(rows, name)
            x = [row.x for row in rows]
            axes.errorbar(x, means, yerr=sds, marker="o", capsize=3, color=f"C{k}", label=method)
            axes.scatter(x, papers, marker="x", color=f"C{k}", zorder=3)
        axes.set(xlabel=result.x_label, ylabel=label, ylim=(0.0, 1.02))
        axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=120)


def _columns(rows: list[Row], name: str) -> tuple[list[float], list[float], list[float]]:
    """Means, deviations and the paper's figures (NaN where it has none)."""
    figures = [row.figures[name] for row in rows]
    papers = [float("nan") if f.paper is None else f.paper for f in figures]
    return [f.mean for f in figures], [f.sd for f in figures], papers
