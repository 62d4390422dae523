"""Results of experiments as rich tables."""

from rich.markup import escape
from rich.table import Table

from calibrator.experiments.result import ExperimentResult, Figure

__all__ = ["result_markdown", "result_table"]

HEADINGS = {"recovery_rate": "10 %", "recovery_rate_25": "25 %", "f2": "f2", "complexity": "hardware"}
LEGEND = (
    "Share recovered within 10 and 25 %, f2 of the hardware classification, share held to have hardware faults; "
    "in brackets the paper."
)


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
        box=None,
        pad_edge=False,
        title=result.title,
        caption=f"{LEGEND} {settings['vehicles']} vehicles, {settings['repetitions']} repetitions, "
        f"seed {settings['seed']}, drive {settings['drive']}.{_failures(result)}",
        caption_justify="left",
        title_justify="left",
    )
    table.add_column(escape(result.x_label), justify="right")
    table.add_column("method", no_wrap=True)
    for heading in HEADINGS.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for row in result.rows:
        table.add_row(f"{row.x:g}", row.method, *(_cell(row.figures[name]) for name in HEADINGS))
    return table


def result_markdown(result: ExperimentResult) -> str:
    """Same table as a page, with what is needed to repeat it."""
    header = [result.x_label, "method", *HEADINGS.values()]
    rows = [[f"{row.x:g}", row.method, *(_cell(row.figures[name]) for name in HEADINGS)] for row in result.rows]
    lines = [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]
    settings = ", ".join(f"{name} {value}" for name, value in result.settings.items())
    return "\n".join(
        [
            f"# {result.title}",
            "",
            f"Written by `calibrator experiment {result.name} --out FOLDER`. {LEGEND}{_failures(result)}",
            "",
            *lines,
            "",
            f"![{result.title}]({result.name}.png)",
            "",
            f"Settings: {settings}.",
            "",
        ]
    )


def _cell(figure: Figure) -> str:
    paper = "" if figure.paper is None else f" ({figure.paper:.2f})"
    return f"{figure.mean:.3f}{paper}"


def _failures(result: ExperimentResult) -> str:
    """Say where an optimisation failed; empty if none did."""
    failed = {f"{row.x:g} {row.method}": row.figures["failed"].mean for row in result.rows}
    named = [f"{name} {share:.3f}" for name, share in failed.items() if share]
    return f" Optimisation failed for a share of: {', '.join(named)}." if named else ""
