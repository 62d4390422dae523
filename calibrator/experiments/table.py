"""Results of experiments as tables: for the console, and as pages; captions name the columns that are there alone."""

from collections.abc import Sequence
from dataclasses import replace

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from calibrator.experiments.baselines import BASELINES
from calibrator.experiments.calibration_experiment import ALL, pooled_bins, pooled_share
from calibrator.experiments.methods import CEILING, LEFT_IN, POSTERIOR
from calibrator.experiments.outcome import calibration_figures
from calibrator.experiments.result import ExperimentResult, Figure, Row, Settings
from calibrator.terminal.text import counted

__all__ = [
    "DETAILS", "PAPER", "caption", "headline", "markdown_table", "repetitions_text", "result_markdown", "result_table",
]  # fmt: skip

PAPER = "paper"
PUBLISHED = "published"
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
        "share of the corrected ones of which some branch gets worse on an unseen drive, however little (harmed), and "
        "what it is at most (one-sided, 95 %)",
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
DETAILS = {name: heading for name, (heading, _) in FIGURES.items()}
COUNTED = ("sure_wrong", "corrected", "harmed", "named", "misnamed", *(name for name in FIGURES if "_beyond_" in name))
"""Shares that stand beside their counts."""
COVERAGE = ("gain_within_1", "gain_beyond_3", "offset_within_1", "offset_beyond_3")
HONESTY = ("confidence", "sure_wrong", "ece", "ece_by_chance", "deployed", "harmed", "delay_rmse_ms")
ATTACKS = ("corrected", "harmed", "worst_a", "named", "misnamed", "sure_wrong")
HEADLINES = {"attacks": ATTACKS, "coverage": COVERAGE}
"""Figures of the headline by experiment; the others show :data:`HONESTY`."""
SHORT = ("confidence", "ece", "delay_rmse_ms", "harmed", "worst_a", *COVERAGE)
"""Those of them that fit on a console of 80 columns."""
PAGES_ALONE = (CEILING.name, *(method.name for method in BASELINES[1:]))
"""Methods for which only pages have room."""
SHARED_ONCE = f"Settings that several experiments share are the same trials and count once in '{ALL}'."
CORRECTS_ALL = (
    "The published method corrects every branch that it regresses, a sound one by what noise leaves there: such a "
    "vehicle counts as harmed although it is recovered."
)
NOTHING = "-"
DEFAULT = POSTERIOR.name


def headline(result: ExperimentResult, *, short: bool = False) -> tuple[list[str], list[list[str]]]:
    """Paper, published method and default side by side, or whatever methods were run.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    short : bool
        Whether it is for a console. Figures besides the recovery are of the default, or where it was not run of the
        first method with a confidence.

    Returns
    -------
    header : list of str
        Columns.
    rows : list of list of str
        One per setting.
    """
    series = [result.series_label] if result.series_label else []
    has_paper, shown, owner = _has_paper(result), _shown(result, short=short), _owner(result)
    header = [*series, result.x_label, *([PAPER] if has_paper else []), *result.methods]
    lines = []
    for key in dict.fromkeys((row.series, row.x) for row in result.rows):
        rows = {row.method: row for row in result.rows if (row.series, row.x) == key}
        cells = [key[0]] if series else []
        cells.append(f"{key[1]:g}")
        if has_paper:
            best = _best_of_paper(result, key[1])
            cells.append(NOTHING if best is None else f"{best:.2f}")
        cells += [_cell(rows.get(method), "recovery_rate") for method in result.methods]
        lines.append([*cells, *(_cell(rows.get(owner), name, short=short) for name in shown)])
    return [*header, *(DETAILS[name] for name in shown)], lines


def caption(results: Sequence[ExperimentResult], *, short: bool = False) -> str:
    """Explain the columns of the headlines of results.

    Parameters
    ----------
    results : sequence of ExperimentResult
        Whose headlines are shown below each other.
    short : bool
        As in :func:`headline`.

    Returns
    -------
    str
        Sentences; a column that no headline has is not mentioned.
    """
    columns = list(dict.fromkeys(method for result in results for method in result.methods))
    columns += [PAPER] if any(_has_paper(result) for result in results) else []
    there = {PUBLISHED if name.startswith(f"{PUBLISHED}/") else name for name in columns}
    own = [f"{name} (a method of one's own)" for name in columns if name in there and name not in METHODS]
    figures = {name for result in results for name in _shown(result, short=short)}
    owners = dict.fromkeys(_owner(result) for result in results if _shown(result, short=short))
    rates = _listed([text for name, text in METHODS.items() if name in there] + own)
    text = f"Share of vehicles recovered within 10 %: {rates}."
    if figures:
        of = _listed([_called(name) for name in owners])
        text += f" Of {of}: {_listed([text for name, (_, text) in FIGURES.items() if name in figures])}."
    notes = dict.fromkeys(result.note for result in results if result.note)
    if any(row.series == ALL for result in results for row in result.rows):
        notes[SHARED_ONCE] = None
    return " ".join([text, *notes])


def _called(method: str) -> str:
    """A method as sentences call it."""
    return "the default" if method == DEFAULT else method


def _listed(texts: Sequence[str]) -> str:
    """Texts with commas, and 'and' before the last."""
    return " and ".join(part for part in (", ".join(texts[:-1]), *texts[-1:]) if part)


def _has_paper(result: ExperimentResult) -> bool:
    """Whether the paper states some recovery rate."""
    return any(_best_of_paper(result, row.x) is not None for row in result.rows)


def _owner(result: ExperimentResult) -> str:
    """The method whose honesty the headline shows: the default, else the first with a confidence; empty for none."""
    confident = [row.method for row in result.rows if row.bins]
    return DEFAULT if DEFAULT in confident else next(iter(confident), "")


def _shown(result: ExperimentResult, *, short: bool = False) -> list[str]:
    """Figures of the owner in the headline."""
    there = {name for row in result.rows if row.method == _owner(result) for name in row.figures}
    wanted = HEADLINES.get(result.name, HONESTY)
    if short:
        wanted = tuple(name for name in wanted if name in SHORT and (name != "harmed" or result.name in HEADLINES))
    return [name for name in wanted if name in there]


def _detailed(result: ExperimentResult) -> list[str]:
    """Figures in the table of all."""
    hidden = () if result.name == "coverage" else COVERAGE
    return [name for name in DETAILS if name not in hidden and any(name in row.figures for row in result.rows)]


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
    effort = f"{repetitions_text(settings)}, seed {settings['seed']}, drive {settings['drive']}"
    more = "--out writes all figures" if result.made else "result_markdown shows all figures"
    text = f"{caption([shown], short=True)} {more}. {vehicles}{effort}.{_failures(shown)}"
    return Group(Text(result.title, style="bold"), table, Text(text, style="dim"), Text())


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
            f"{command}{caption([result])}{_failures(result)}",
            "",
            *markdown_table(*headline(result)),
            "",
            *_together(result),
            *([f"![{result.title}]({picture})", ""] if picture else []),
            _details_caption(result, paper=in_brackets),
            "",
            *markdown_table(*_details(result)),
            "",
            *_reliability(result),
            *_pit(result),
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
        f"All settings together, by tenths of {_called(owner)}'s confidence (ECE {figures['ece'].mean:.3f}, by chance "
        f"{figures['ece_by_chance'].mean:.3f}):",
        "",
        *markdown_table(["from", "vehicles", "mean confidence", "recovered"], rows),
        "",
    ]


def _cell(row: Row | None, name: str, *, short: bool = False) -> str:
    """A figure; a share that is rare beside its counts and its bound or what is expected."""
    if row is None or name not in row.figures:
        return NOTHING
    figure = row.figures[name]
    share = f"{figure.mean:.1f}" if name == "worst_a" else f"{figure.mean:.3f}"
    if name not in COUNTED or not figure.of:
        return share
    counts = f"{figure.hits} of {figure.of}"
    if short:
        return counts
    beside = "" if name != "harmed" else f", at most {figure.upper:.3f}"
    if figure.expected is not None:
        beside = f", {figure.expected:.1f} expected"
    return f"{share} ({counts}{beside})"


def _together(result: ExperimentResult) -> list[str]:
    """Lines on all settings together: what is rare in one may be told by many."""
    names = ("harmed", "sure_wrong")
    lines = []
    for method in result.methods:
        rows = [row for row in result.rows if row.method == method and row.series != ALL]
        pooled = {name: figure for name in names if (figure := pooled_share(rows, name)) is not None}
        if pooled and len(rows) > 1:
            whole = Row(x=0.0, method=method, figures=pooled)
            lines.append([method, *(_cell(whole, name) for name in names)])
    return [*markdown_table(["all settings together", *(DETAILS[name] for name in names)], lines), ""] if lines else []


def _details_caption(result: ExperimentResult, *, paper: bool) -> str:
    """Explain the columns of the table of all figures; what a caption above explains is not explained again."""
    figures, explained = _detailed(result), _shown(result)
    texts = list(dict.fromkeys(FIGURES[name][1] for name in figures if name not in explained))
    texts += ["the figures above"] if set(figures) & set(explained) else []
    text = f"Of each method: {_listed(texts)}{'; in brackets the paper' if paper else ''}."
    published = any(name.startswith(f"{PUBLISHED}/") for name in result.methods)
    return f"{text} {CORRECTS_ALL}" if "harmed" in figures and published else text


def _pit(result: ExperimentResult) -> list[str]:
    """Lines of the histogram of the probability integral transform; none but where that is the question."""
    rows = [row for row in result.rows if row.pit and row.method == _owner(result)]
    if result.name != "coverage" or not rows:
        return []
    cells = [[row.series, f"{row.x:g}", *(f"{count}" for count in row.pit)] for row in rows]
    total = [sum(counts) for counts in zip(*(row.pit for row in rows), strict=True)]
    header = [result.series_label, result.x_label, *(f"{k / len(total):.1f}" for k in range(len(total)))]
    return [
        "Deployed parameters by tenths of their probability integral transform, which are equal if the posterior is "
        "right (of the simulation-based calibration these are its ranks):",
        "",
        *markdown_table(header, [*cells, [ALL, "", *(f"{count}" for count in total)]]),
        "",
    ]


def _paper(figure: Figure | None) -> str:
    return "" if figure is None or figure.paper is None else f" ({figure.paper:.2f})"


def _best_of_paper(result: ExperimentResult, x: float) -> float | None:
    """Best recovery rate that the paper prints; old records have it in the rows alone."""
    figures = [row.figures["recovery_rate"].paper for row in result.rows if row.x == x]
    return result.paper.get(x, max((figure for figure in figures if figure is not None), default=None))


def _text(value: bool | int | float | str) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def repetitions_text(settings: Settings) -> str:
    """Number of repetitions, in words; pooled records have several: ``2 or 10 repetitions``."""
    count = settings["repetitions"]
    return counted(1, "repetition") if str(count) == "1" else f"{count} repetitions"


def _failures(result: ExperimentResult) -> str:
    """Say where an optimisation failed; empty if none did."""
    failed = {f"{row.series} {row.x:g} {row.method}".strip(): row.figures.get("failed") for row in result.rows}
    named = [f"{name} {figure.mean:.3f}" for name, figure in failed.items() if figure is not None and figure.mean]
    return f" Optimisation failed for a share of: {', '.join(named)}." if named else ""
