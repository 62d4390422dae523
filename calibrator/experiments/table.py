"""Results of experiments as rich tables."""

from rich.markup import escape
from rich.table import Table

from calibrator.experiments.result import ExperimentResult, Figure

__all__ = ["result_table"]

HEADINGS = {
    "recovery_rate": "recovered (10 %)",
    "recovery_rate_25": "recovered (25 %)",
    "f2": "f2",
    "complexity": "complexity",
    "failed": "failed",
}


def result_table(result: ExperimentResult) -> Table:
    """Table of a result: mean over repetitions, and in brackets what the paper states.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.

    Returns
    -------
    rich.table.Table
        One row per setting and method.
    """
    settings = result.settings
    table = Table(
        title=result.title,
        caption=f"{settings['vehicles']} vehicles, {settings['repetitions']} repetitions, seed {settings['seed']}, "
        f"drive {settings['drive']}; in brackets the paper",
    )
    table.add_column(escape(result.x_label), justify="right")
    table.add_column("method")
    for heading in HEADINGS.values():
        table.add_column(heading, justify="right")
    for row in result.rows:
        table.add_row(f"{row.x:g}", row.method, *(_cell(row.figures[name]) for name in HEADINGS))
    return table


def _cell(figure: Figure) -> str:
    paper = "" if figure.paper is None else f" ({figure.paper:.2f})"
    return f"{figure.mean:.3f}{paper}"
