"""Results of experiments as tables on the console, and as pages with their pictures in a folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from calibrator.experiments.baselines import BASELINES
from calibrator.experiments.calibration import ALL, CALIBRATION, pooled_bins, pooled_share
from calibrator.experiments.experiments import COVERAGE, EXPERIMENTS, Experiment
from calibrator.experiments.methods import CEILING, LEFT_IN, POSTERIOR
from calibrator.experiments.outcome import calibration_figures
from calibrator.experiments.picture import write_picture
from calibrator.experiments.result import ExperimentResult, Row, read_results
from calibrator.terminal.text import counted
from ecu_node.documents import write_atomically

__all__ = ["FIGURES", "ORDER", "headline", "result_markdown", "result_table", "write_result"]

ORDER = (*EXPERIMENTS, CALIBRATION)
"""Experiments in the order of the index."""
PAPER, PUBLISHED = "paper", "published"
METHODS = {
    PAPER: "the paper's best printed figure",
    PUBLISHED: "the published method (/ its classifier)",
    "best subset": "best subset with BIC on the default's evidence",
    "LASSO": "LASSO with refit on the same",
    "fleet median": "regression on the fleet's median",
    "total least squares": "total least squares on the junction law",
    "VDI 2048": "reconciliation by VDI 2048",
    POSTERIOR.name: "the default (posterior)",
    LEFT_IN.name: "the default with the delays left in",
    CEILING.name: "the default if it is told how the faults were drawn (law known: the most that this evidence gives)",
}
FIGURES = {
    "recovery_rate": ("10 %", "share of vehicles recovered within 10 %"),
    "recovery_rate_25": ("25 %", "within 25 %"),
    "f2": ("f2", "f2 of the hardware classification"),
    "complexity": ("hardware", "share held to have hardware faults (hardware)"),
    "confidence": ("confidence", "mean confidence"),
    "sure": ("> 0.95", "share of vehicles above 0.95"),
    "sure_confidence": ("their confidence", "their mean confidence"),
    "sure_recovered": ("of them recovered", "the share of them that is recovered"),
    "sure_wrong": ("> 0.95, wrong", "of the vehicles above 0.95 those not recovered, and how many they expect"),
    "ece": ("ECE", "expected calibration error (ECE, by tenths)"),
    "ece_by_chance": ("by chance", "what it is by chance if the confidence is exact"),
    "corrected": ("corrected", "share of the vehicles that is corrected in some branch (corrected)"),
    "deployed": ("deployed", "share of the vehicles with faulty sensors that is corrected in some branch (deployed)"),
    "harmed": (
        "harmed",
        "share of the corrected ones of which some branch gets worse on an unseen drive, however little (harmed)",
    ),
    "worst_a": ("worst [A]", "largest worsening of a branch's root mean square error (worst)"),
    "named": ("named", "share of the vehicles attacked of which a finding names the cause (named)"),
    "misnamed": ("misnamed", "share of the others of which a finding names any cause (misnamed)"),
    "gain_within_1": ("gain, within 1", "share of the deployed gain errors within 1 standard deviation of the truth"),
    "gain_beyond_3": ("gain, beyond 3", "beyond 3"),
    "offset_within_1": ("offset, within 1", "the same of the offsets"),
    "offset_beyond_3": ("offset, beyond 3", "beyond 3"),
    "delay_rmse_ms": ("delay error [ms]", "root mean square error of the estimated delays"),
}
"""Heading and explanation of each figure, in the order of the columns."""
COUNTED = ("sure_wrong", "harmed", "named", "misnamed", "gain_beyond_3", "offset_beyond_3")
"""Shares that are rare, and stand beside their counts."""
SHORT = ("confidence", "ece", "delay_rmse_ms", "worst_a", *COVERAGE)
"""Figures for which a console of 80 columns has room."""
PAGES_ALONE = (CEILING.name, *(method.name for method in BASELINES[1:]))
"""Methods for which only pages have room."""
INTERVALS = "In brackets: 95 % intervals (Clopper and Pearson), for which vehicles are independent."
SHARED_ONCE = f"Settings that several experiments share are the same trials and count once in '{ALL}'."
CORRECTS_ALL = (
    "The published method corrects every branch that it regresses, a sound one by what noise leaves there: such a "
    "vehicle counts as harmed although it is recovered."
)
NOTHING = "-"


def headline(result: ExperimentResult, *, short: bool = False) -> tuple[list[str], list[list[str]]]:
    """Recovery of the paper and of all methods side by side, and the figures of the default's honesty.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    short : bool
        Whether it is for a console.

    Returns
    -------
    header : list of str
        Columns. Figures besides the recovery are of the default, or where it was not run of the first method with a
        confidence.
    rows : list of list of str
        One per setting.
    """
    names, owner = _shown(result, short=short), _owner(result)
    lines = []
    for series, x in dict.fromkeys((row.series, row.x) for row in result.rows):
        rows = {row.method: row for row in result.rows if (row.series, row.x) == (series, x)}
        paper = f"{result.paper[x]:.2f}" if x in result.paper else NOTHING
        cells = [*([series] if result.series_label else []), f"{x:g}", *([paper] if result.paper else [])]
        cells += [_cell(rows.get(method), "recovery_rate", short=short) for method in result.methods]
        lines.append([*cells, *(_cell(rows.get(owner), name, short=short) for name in names)])
    paper_column = [PAPER] if result.paper else []
    headings = [FIGURES[name][0] for name in names]
    return [*_keys(result), *paper_column, *result.methods, *headings], lines


def _keys(result: ExperimentResult) -> list[str]:
    """Headings of what tells rows apart."""
    return [*([result.series_label] if result.series_label else []), result.x_label]


def _owner(result: ExperimentResult) -> str:
    """The method whose honesty the headline shows: the default, else the first with a confidence; empty for none."""
    confident = [row.method for row in result.rows if row.bins]
    return POSTERIOR.name if POSTERIOR.name in confident else next(iter(confident), "")


def _shown(result: ExperimentResult, *, short: bool = False) -> list[str]:
    """Figures of the owner in the headline."""
    there = {name for row in result.rows if row.method == _owner(result) for name in row.figures}
    wanted = EXPERIMENTS[result.name].shown if result.name in EXPERIMENTS else Experiment.shown
    short_names = (*SHORT, "harmed") if wanted != Experiment.shown else SHORT
    return [name for name in wanted if name in there and (not short or name in short_names)]


def _detailed(result: ExperimentResult) -> list[str]:
    """Figures in the table of all."""
    hidden = () if result.name == "coverage" else COVERAGE
    return [name for name in FIGURES if name not in hidden and any(name in row.figures for row in result.rows)]


def _cell(row: Row | None, name: str, *, short: bool = False) -> str:
    """A figure; a share with its interval, and one that is rare with its counts and what is expected."""
    if row is None or name not in row.figures:
        return NOTHING
    figure = row.figures[name]
    text = f"{figure.mean:.1f}" if name == "worst_a" else f"{figure.mean:.3f}"
    counts = f"{figure.hits} of {figure.of}" if name in COUNTED and figure.of else ""
    if short or figure.interval is None:
        return counts or text
    low, high = figure.interval
    beside = f"; {counts}" if counts else ""
    if figure.expected is not None:
        beside += f", {figure.expected:.1f} expected"
    return f"{text} ({low:.3f} to {high:.3f}{beside})"


def _caption(results: Sequence[ExperimentResult], *, short: bool = False) -> str:
    """Explain the columns of the headlines of results; a column that none of them has is not mentioned."""
    methods = list(dict.fromkeys(method for result in results for method in result.methods))
    there = {PUBLISHED if name.startswith(f"{PUBLISHED}/") else name for name in methods}
    there |= {PAPER} if any(result.paper for result in results) else set()
    own = [f"{name} (a method of one's own)" for name in methods if name in there - METHODS.keys()]
    figures = {name for result in results for name in _shown(result, short=short)}
    owners = dict.fromkeys(_called(_owner(result)) for result in results if _shown(result, short=short))
    text = f"Share of vehicles recovered within 10 %: {_listed([METHODS[n] for n in METHODS if n in there] + own)}."
    if figures:
        text += f" Of {_listed([*owners])}: {_listed([t for name, (_, t) in FIGURES.items() if name in figures])}."
    notes = dict.fromkeys(result.note for result in results if result.note)
    if any(row.series == ALL for result in results for row in result.rows):
        notes[SHARED_ONCE] = None
    return " ".join([text, *([] if short else [INTERVALS]), *notes])


def _called(method: str) -> str:
    """A method as sentences call it."""
    return "the default" if method == POSTERIOR.name else method


def _listed(texts: Sequence[str]) -> str:
    """Texts with commas, and 'and' before the last."""
    return " and ".join(part for part in (", ".join(texts[:-1]), *texts[-1:]) if part)


def _repetitions(result: ExperimentResult) -> str:
    count = result.settings["repetitions"]
    return counted(1, "repetition") if str(count) == "1" else f"{count} repetitions"


def _failures(result: ExperimentResult) -> str:
    """Say where an optimisation failed; empty if none did."""
    failed = {f"{row.series} {row.x:g} {row.method}".strip(): row.figures.get("failed") for row in result.rows}
    named = [f"{name} {figure.mean:.3f}" for name, figure in failed.items() if figure is not None and figure.mean]
    return f" Optimisation failed for a share of: {', '.join(named)}." if named else ""


def result_table(result: ExperimentResult) -> Group:
    """Headline of a result for the console: title, table and caption, which is as wide as the console."""
    shown = replace(result, rows=tuple(row for row in result.rows if row.method not in PAGES_ALONE))
    table = Table(box=None, pad_edge=False, collapse_padding=True)
    header, rows = headline(shown, short=True)
    for number, heading in enumerate(header):
        first = number == 0 and bool(result.series_label)
        text = escape(heading).replace("/", "/\n").replace(", ", ",\n")
        table.add_column(text, justify="left" if first else "right", no_wrap=first, overflow="fold")
    for row in rows:
        table.add_row(*row)
    settings = result.settings
    vehicles = f"{settings['vehicles']} vehicles, " if isinstance(settings.get("vehicles"), int) else ""
    effort = f"{_repetitions(result)}, seed {settings['seed']}, drive {settings['drive']}"
    more = "--out writes all figures" if result.made else "result_markdown shows all figures"
    text = f"{_caption([shown], short=True)} {more}. {vehicles}{effort}.{_failures(shown)}"
    return Group(Text(result.title, style="bold"), table, Text(text, style="dim"), Text())


def result_markdown(result: ExperimentResult, *, picture: str = "") -> str:
    """Result as a page (Markdown), with what is needed to repeat it.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    picture : str
        File of its picture, as the page is to link it; empty: there is none.
    """
    command = f"Written by `calibrator experiment {result.name} --out FOLDER`. " if result.made else ""
    settings = ", ".join(
        f"{name} {str(value).lower() if isinstance(value, bool) else value}" for name, value in result.settings.items()
    )
    lines = [f"# {result.title}", "", f"{command}{_caption([result])}{_failures(result)}", ""]
    lines += [*_markdown(*headline(result)), "", *_together(result)]
    lines += [f"![{result.title}]({picture})", ""] if picture else []
    lines += [*_details(result), *_reliability(result), *_pit(result)]
    return "\n".join([*lines, f"Settings: {settings}.{f' Made by {result.made}.' if result.made else ''}", ""])


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def _together(result: ExperimentResult) -> list[str]:
    """Lines on all settings together: what is rare in one may be told by many."""
    names, lines = ("harmed", "sure_wrong"), []
    for method in result.methods:
        rows = [row for row in result.rows if row.method == method and row.series != ALL]
        pooled = {name: figure for name in names if (figure := pooled_share(rows, name)) is not None}
        if pooled and len(rows) > 1:
            whole = Row(x=0.0, method=method, figures=pooled)
            lines.append([method, *(_cell(whole, name) for name in names)])
    header = ["all settings together", *(FIGURES[name][0] for name in names)]
    return [*_markdown(header, lines), ""] if lines else []


def _details(result: ExperimentResult) -> list[str]:
    """All figures of all rows, the paper's after a stroke, and what the columns mean that are not in the headline."""
    names, rows = _detailed(result), []
    for row in result.rows:
        cells = []
        for name in names:
            figure = row.figures.get(name)
            paper = "" if figure is None or figure.paper is None else f" / {figure.paper:.2f}"
            cells.append(_cell(row, name) + paper)
        rows.append([*([row.series] if result.series_label else []), f"{row.x:g}", row.method, *cells])
    more = dict.fromkeys(FIGURES[name][1] for name in names if name not in _shown(result))
    text = f"All figures; besides those above {_listed([*more])}." if more else "All figures."
    if result.paper:
        text += " After a stroke: the paper."
    if "harmed" in names and any(name.startswith(f"{PUBLISHED}/") for name in result.methods):
        text += f" {CORRECTS_ALL}"
    return [text, "", *_markdown([*_keys(result), "method", *(FIGURES[name][0] for name in names)], rows), ""]


def _reliability(result: ExperimentResult) -> list[str]:
    """Lines that compare the owner's confidence with what became of it; none without a confidence."""
    rows_of_owner = [row for row in result.rows if row.method == _owner(result)]
    bins = pooled_bins([row for row in rows_of_owner if row.series == ALL] or rows_of_owner)
    if not bins:
        return []
    rows = [[f"{b.low:.1f}", f"{b.count}", f"{b.confidence:.3f}", f"{b.recovered:.3f}"] for b in bins]
    ece, chance = (figure.mean for figure in calibration_figures(bins).values())
    return [
        f"All settings together, by tenths of {_called(_owner(result))}'s confidence (ECE {ece:.3f}, by chance "
        f"{chance:.3f}):",
        "",
        *_markdown(["from", "vehicles", "mean confidence", "recovered"], rows),
        "",
    ]


def _pit(result: ExperimentResult) -> list[str]:
    """Lines of the histogram of the probability integral transform; none but where that is the question."""
    rows = [row for row in result.rows if row.pit and row.method == _owner(result)]
    if result.name != "coverage" or not rows:
        return []
    cells = [[row.series, f"{row.x:g}", *(f"{count}" for count in row.pit)] for row in rows]
    total = [sum(counts) for counts in zip(*(row.pit for row in rows), strict=True)]
    return [
        "Deployed parameters by tenths of their probability integral transform, which are equal if the posterior is "
        "right (of the simulation-based calibration these are its ranks):",
        "",
        *_markdown(
            [*_keys(result), *(f"{k / len(total):.1f}" for k in range(len(total)))],
            [*cells, [ALL, "", *(f"{count}" for count in total)]],
        ),
        "",
    ]


def write_result(folder: Path, result: ExperimentResult) -> None:
    """Write NAME.json, NAME.md and NAME.png into a folder, and beside it the index ``FOLDER.md`` of all its results.

    Raises
    ------
    FleetError
        If another record of the folder is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{result.name}.json", result.to_json())
    write_atomically(folder / f"{result.name}.md", result_markdown(result, picture=f"{result.name}.png").encode())
    write_picture(result, folder / f"{result.name}.png")
    results = read_results(folder, dict.fromkeys([*ORDER, result.name]))
    lines = ["# Results of the experiments", "", f"Written by `calibrator experiment`. {_caption(results)}", ""]
    for each in results:
        lines += [
            f"## [{each.title}]({folder.name}/{each.name}.md)",
            "",
            f"`calibrator experiment {each.name}`: {_repetitions(each)}, seed {each.settings['seed']}, "
            f"drive {each.settings['drive']}{f'; {each.made}' if each.made else ''}.",
            "",
            *_markdown(*headline(each)),
            "",
        ]
    write_atomically(folder.parent / f"{folder.name}.md", "\n".join(lines).encode())
