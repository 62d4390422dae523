"""Results of experiments as tables: for the console, and as pages."""

from collections.abc import Collection, Sequence
from dataclasses import replace

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from calibrator.experiments.calibration_experiment import ALL, pooled_bins
from calibrator.experiments.caption import PAPER, called, details_caption, headline_caption
from calibrator.experiments.methods import CEILING, POSTERIOR
from calibrator.experiments.outcome import calibration_figures
from calibrator.experiments.result import ExperimentResult, Figure, Row, Settings
from calibrator.terminal.text import counted

__all__ = ["caption", "headline", "markdown_table", "repetitions_text", "result_markdown", "result_table"]

HONESTY = {
    "confidence": "confidence",
    "sure": "> 0.95",
    "sure_confidence": "their confidence",
    "sure_recovered": "of them recovered",
    "ece": "ECE",
    "ece_by_chance": "by chance",
    "deployed": "deployed",
    "harmed": "harmed",
    "delay_rmse_ms": "delay error [ms]",
}
DETAILS = {"recovery_rate": "10 %", "recovery_rate_25": "25 %", "f2": "f2", "complexity": "hardware", **HONESTY}
SHORT = ("confidence", "ece", "delay_rmse_ms")
"""What fits on a console of 80 columns."""
SHARED_ONCE = f"Settings that several experiments share are the same trials and count once in '{ALL}'."
NOTHING = "-"
DEFAULT = POSTERIOR.name


def headline(result: ExperimentResult, honesty: Collection[str] = tuple(HONESTY)) -> tuple[list[str], list[list[str]]]:
    """Paper, published method and default side by side, or whatever methods were run.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    honesty : collection of str
        Figures that are shown besides, of the default, or where it was not run of the first method with a confidence.

    Returns
    -------
    header : list of str
        Columns.
    rows : list of list of str
        One per setting.
    """
    series = [result.series_label] if result.series_label else []
    has_paper, shown, owner = _has_paper(result), _shown(result, honesty), _owner(result)
    header = [*series, result.x_label, *([PAPER] if has_paper else []), *result.methods]
    lines = []
    for key in dict.fromkeys((row.series, row.x) for row in result.rows):
        rows = {row.method: row for row in result.rows if (row.series, row.x) == key}
        cells = [key[0]] if series else []
        cells.append(f"{key[1]:g}")
        if has_paper:
            cells.append(_number(_best_of_paper(result, key[1])))
        cells += [_cell(rows.get(method), "recovery_rate") for method in result.methods]
        lines.append([*cells, *(_cell(rows.get(owner), name) for name in shown)])
    return [*header, *(HONESTY[name] for name in shown)], lines


def caption(results: Sequence[ExperimentResult], honesty: Collection[str] = tuple(HONESTY)) -> str:
    """Explain the columns of the headlines of results.

    Parameters
    ----------
    results : sequence of ExperimentResult
        Whose headlines are shown below each other.
    honesty : collection of str
        As in :func:`headline`.

    Returns
    -------
    str
        Sentences; a column that no headline has is not mentioned.
    """
    columns = [name for result in results for name in (*result.methods, *([PAPER] if _has_paper(result) else []))]
    figures = {name for result in results for name in _shown(result, honesty)}
    owners = dict.fromkeys(_owner(result) for result in results if _shown(result, honesty))
    text = headline_caption(list(dict.fromkeys(columns)), figures, list(owners))
    pooled = any(row.series == ALL for result in results for row in result.rows)
    return f"{text} {SHARED_ONCE}" if pooled else text


def _has_paper(result: ExperimentResult) -> bool:
    """Whether the paper states some recovery rate."""
    return any(_best_of_paper(result, row.x) is not None for row in result.rows)


def _owner(result: ExperimentResult) -> str:
    """The method whose honesty the headline shows: the default, else the first with a confidence; empty for none."""
    confident = [row.method for row in result.rows if row.bins]
    return DEFAULT if DEFAULT in confident else next(iter(confident), "")


def _shown(result: ExperimentResult, honesty: Collection[str] = tuple(HONESTY)) -> list[str]:
    """Figures of the owner in the headline."""
    there = {name for row in result.rows if row.method == _owner(result) for name in row.figures}
    return [name for name in HONESTY if name in honesty and name in there]


def _detailed(result: ExperimentResult) -> list[str]:
    """Figures in the table of all."""
    return [name for name in DETAILS if any(name in row.figures for row in result.rows)]


def result_table(result: ExperimentResult) -> Group:
    """Headline of a result for the console: title, table and caption, which is as wide as the console."""
    shown = _without_ceiling(result)
    table = Table(box=None, pad_edge=False, collapse_padding=True)
    header, rows = headline(shown, SHORT)
    for number, heading in enumerate(header):
        first = number == 0 and bool(result.series_label)
        text = escape(heading).replace("/", "/\n").replace(", ", ",\n")
        table.add_column(text, justify="left" if first else "right", no_wrap=first, overflow="fold")
    for row in rows:
        table.add_row(*row)
    settings = result.settings
    vehicles = f"{settings['vehicles']} vehicles, " if isinstance(settings.get("vehicles"), int) else ""
    effort = f"{repetitions_text(settings)}, seed {settings['seed']}, drive {settings['drive']}"
    more = "--out writes all figures" if result.made else "result_markdown shows all figures"
    text = f"{caption([shown], SHORT)} {more}. {vehicles}{effort}.{_failures(shown)}"
    return Group(Text(result.title, style="bold"), table, Text(text, style="dim"), Text())


def _without_ceiling(result: ExperimentResult) -> ExperimentResult:
    """The result without the rows that only pages have room for."""
    return replace(result, rows=tuple(row for row in result.rows if row.method != CEILING.name))


def result_markdown(result: ExperimentResult, *, picture: str = "") -> str:
    """Result as a page, with what is needed to repeat it.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    picture : str
        File of its picture, as the page is to link it; empty: there is none.

    Returns
    -------
    str
        Markdown.
    """
    settings = ", ".join(f"{name} {_text(value)}" for name, value in result.settings.items())
    command = f"Written by `calibrator experiment {result.name} --out FOLDER`. " if result.made else ""
    in_brackets = any(figure.paper is not None for row in result.rows for figure in row.figures.values())
    return "\n".join(
        [
            f"# {result.title}",
            "",
            f"{command}{caption([result])}{_balance(result)}{_failures(result)}",
            "",
            *markdown_table(*headline(result)),
            "",
            *([f"![{result.title}]({picture})", ""] if picture else []),
            details_caption(_detailed(result), _shown(result), result.methods, paper=in_brackets),
            "",
            *markdown_table(*_details(result)),
            "",
            *_reliability(result),
            f"Settings: {settings}.{f' Made by {result.made}.' if result.made else ''}",
            "",
        ]
    )


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def _details(result: ExperimentResult) -> tuple[list[str], list[list[str]]]:
    """All figures of all rows, the paper's in brackets."""
    names = _detailed(result)
    series = [result.series_label] if result.series_label else []
    lines = []
    for row in result.rows:
        label = [row.series] if series else []
        figures = (_cell(row, name) + _paper(row.figures.get(name)) for name in names)
        lines.append([*label, f"{row.x:g}", row.method, *figures])
    return [*series, result.x_label, "method", *(DETAILS[name] for name in names)], lines


def _reliability(result: ExperimentResult) -> list[str]:
    """Lines that compare the owner's confidence with what became of it; none without a confidence."""
    owner = _owner(result)
    rows_of_owner = [row for row in result.rows if row.method == owner]
    bins = pooled_bins([row for row in rows_of_owner if row.series == ALL] or rows_of_owner)
    if not bins:
        return []
    rows = [[f"{b.low:.1f}", f"{b.count}", f"{b.confidence:.3f}", f"{b.recovered:.3f}"] for b in bins]
    figures = calibration_figures(bins)
    return [
        f"All settings together, by tenths of {called(owner)}'s confidence (ECE {figures['ece']:.3f}, by chance "
        f"{figures['ece_by_chance']:.3f}):",
        "",
        *markdown_table(["from", "vehicles", "mean confidence", "recovered"], rows),
        "",
    ]


def _cell(row: Row | None, name: str) -> str:
    if row is None or name not in row.figures:
        return NOTHING
    return f"{row.figures[name].mean:.3f}"


def _paper(figure: Figure | None) -> str:
    return "" if figure is None or figure.paper is None else f" ({figure.paper:.2f})"


def _best_of_paper(result: ExperimentResult, x: float) -> float | None:
    """Best recovery rate that the paper prints; old records have it in the rows alone."""
    figures = [row.figures["recovery_rate"].paper for row in result.rows if row.x == x]
    return result.paper.get(x, max((figure for figure in figures if figure is not None), default=None))


def _number(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.2f}"


def _text(value: bool | int | float | str) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def repetitions_text(settings: Settings) -> str:
    """Number of repetitions, in words; pooled records have several: ``2 or 10 repetitions``."""
    count = settings["repetitions"]
    return counted(1, "repetition") if str(count) == "1" else f"{count} repetitions"


def _balance(result: ExperimentResult) -> str:
    """What is to be known of recorded currents; empty for others."""
    branch = result.settings.get("balance_branch")
    if branch is None:
        return ""
    return (
        f" In every trip the current of {branch} is minus the sum of the other branches: it is not independent of "
        "their sensors, and true currents sum to 0 A but for a load that is put in."
    )


def _failures(result: ExperimentResult) -> str:
    """Say where an optimisation failed; empty if none did."""
    failed = {f"{row.series} {row.x:g} {row.method}".strip(): row.figures.get("failed") for row in result.rows}
    named = [f"{name} {figure.mean:.3f}" for name, figure in failed.items() if figure is not None and figure.mean]
    return f" Optimisation failed for a share of: {', '.join(named)}." if named else ""
