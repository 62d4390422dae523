"""Results of experiments as tables on the console, and as pages with their pictures in a folder."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation
from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from calibrator.drive import Array
from calibrator.experiments.experiments import (
    COVERAGE,
    EXPERIMENTS,
    KEYS,
    Experiment,
    ExperimentResult,
    read_records,
)
from calibrator.experiments.figures import ALL, FIGURES, calibration_errors, pool_figures, pool_tenths
from calibrator.experiments.methods import BASELINES, CEILING, LEFT_IN, MEANINGS, PERFECT, POSTERIOR, THRESHOLD, TREE
from calibrator.terminal.text import counted
from ecu_node.documents import write_atomically

__all__ = ["draw_result", "headline", "result_markdown", "result_table", "write_page"]

SHORT = ("confidence", "ece", "delay_rmse_ms", "worst_a", *COVERAGE)
"""Figures for which a console of 80 columns has room."""
PAGES_ALONE = (CEILING.name, *(method.name for method in BASELINES[1:]))
"""Methods for which only pages have room."""
NOTHING = "-"


def headline(result: ExperimentResult, *, short: bool = False) -> pd.DataFrame:
    """Recovery of the paper and of all methods side by side, and the figures of the default's honesty, as texts.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    short : bool
        Whether it is for a console.

    Returns
    -------
    DataFrame
        A row per setting. Figures besides the recovery are of the default, or where it was not run of the first method
        with a confidence.
    """
    experiment = result.experiment
    cells = _texts(result.figures, short=short).pivot_table(
        index=["series", "x"], columns=["method", "figure"], values="text", sort=False, aggfunc="first", dropna=False
    )
    cells = cells.reindex(list(dict.fromkeys(zip(result.figures["series"], result.figures["x"], strict=True))))
    columns = {method: cells.get((method, "recovery_rate")) for method in result.methods}
    columns |= {FIGURES[name].heading: cells.get((_owner(result), name)) for name in _shown(result, short=short)}
    table = pd.DataFrame(columns, index=cells.index, dtype=object)
    if experiment.paper:  # its best figure, whatever methods were run
        best = dict(sorted((x, figures["recovery_rate"]) for (x, _), figures in experiment.paper.items()))
        table.insert(0, "paper", [f"{best[x]:.2f}" if x in best else NOTHING for _, x in table.index])
    return _labelled(table, experiment)


def _labelled(table: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Table whose index, what is varied, has become columns with labels; without series, if there are none."""
    table = table.fillna(NOTHING).reset_index()
    table["x"] = ["" if np.isnan(x) else f"{x:g}" for x in table["x"]]
    table = table if experiment.series_label else table.drop(columns="series")
    return table.rename(columns={"series": experiment.series_label, "x": experiment.x_label})


def _owner(result: ExperimentResult) -> str:
    """The method whose honesty the headline shows: the default, else the first with a confidence; empty for none."""
    confident = result.figures.loc[result.figures["figure"] == "confidence", "method"].tolist()
    return POSTERIOR.name if POSTERIOR.name in confident else next(iter(confident), "")


def _shown(result: ExperimentResult, *, short: bool = False) -> list[str]:
    """Figures of the owner in the headline."""
    there = set(result.figures.loc[result.figures["method"] == _owner(result), "figure"])
    wanted = result.experiment.shown
    fits = {*SHORT, "harmed"} if wanted != Experiment.shown else {*SHORT}
    return [name for name in wanted if name in there and (not short or name in fits)]


def _texts(figures: pd.DataFrame, *, short: bool = False) -> pd.DataFrame:
    """Figures with their ``text``: a share with its interval, a rare one with its counts and what is expected."""
    sure = figures[figures["figure"] == "sure_confidence"].set_index(KEYS)["value"].to_dict()
    texts = []
    for row in figures.itertuples():
        rare, share = FIGURES[row.figure].rare, not np.isnan(row.low)
        text = f"{row.value:.1f}" if row.figure == "worst_a" else f"{row.value:.3f}"
        counts = f"{round(row.value * row.of)} of {row.of:.0f}" if rare and share else ""
        if row.figure == "sure_wrong" and not short:
            counts += f", {(1.0 - sure[row.series, row.x, row.method]) * row.of:.1f} expected"
        whole = "; ".join(filter(None, (f"{row.low:.3f} to {row.high:.3f}", counts)))
        texts.append((counts or text) if short or not share else f"{text} ({whole})")
    return figures.assign(text=texts)


def _caption(results: Sequence[ExperimentResult], *, short: bool = False) -> str:
    """Explain the columns of the headlines of results; a column that none of them has is not mentioned."""
    methods = dict.fromkeys(method for result in results for method in result.methods)
    named = {name: MEANINGS.get(name, "a method of one's own") for name in methods if not name.startswith("published/")}
    means = ["paper (its best printed figure)"] if any(result.experiment.paper for result in results) else []
    means += ["published/classifier (the published method)"] if len(named) < len(methods) else []
    means += [f"{name} ({meaning})" for name, meaning in named.items()]
    texts = [f"Share of vehicles recovered within 10 %: {', '.join(means)}."]
    by_result = [(_owner(result), _shown(result, short=short)) for result in results]
    if any(shown for _, shown in by_result):
        owners = dict.fromkeys(_called(owner) for owner, shown in by_result if shown)
        names = [name for name in FIGURES if any(name in shown for _, shown in by_result)]
        texts.append(f"Of {' and '.join(owners)}: {_explained(names)}.")
    if not short:
        texts.append("In brackets: 95 % intervals (Clopper and Pearson), for which vehicles are independent.")
    texts += dict.fromkeys(result.experiment.note for result in results if result.experiment.note)
    texts += [
        f"In every trip the current of {branch} is minus the sum of the other branches: it is not independent "
        "of their sensors, and true currents sum to 0 A but for a load that is put in."
        for branch in dict.fromkeys(result.settings.get("balance_branch") for result in results)
        if branch is not None
    ]
    if any((result.figures["series"] == ALL).any() for result in results):
        texts.append(f"Settings that several experiments share are the same trials and count once in '{ALL}'.")
    return " ".join(texts)


def _explained(names: Iterable[str]) -> str:
    return ", ".join(f"{FIGURES[name].heading} ({FIGURES[name].meaning})" for name in names)


def _called(method: str) -> str:
    """A method as sentences call it."""
    return "the default" if method == POSTERIOR.name else method


def _effort(result: ExperimentResult) -> str:
    count = str(result.settings["repetitions"])
    times = counted(int(count), "repetition") if count.isdecimal() else f"{count} repetitions"
    return f"{times}, seed {result.settings['seed']}, drive {result.settings['drive']}"


def result_table(result: ExperimentResult) -> Group:
    """Headline of a result for the console: title, table and caption, which is as wide as the console."""
    shown = replace(result, figures=result.figures[~result.figures["method"].isin(PAGES_ALONE)])
    table, cells = Table(box=None, pad_edge=False, collapse_padding=True), headline(shown, short=True)
    for number, heading in enumerate(cells.columns):
        first = number == 0 and bool(result.experiment.series_label)
        text = escape(heading).replace("/", "/\n").replace(", ", ",\n")
        table.add_column(text, justify="left" if first else "right", no_wrap=first, overflow="fold")
    for row in cells.to_numpy():
        table.add_row(*row)
    vehicles = f"{result.settings['vehicles']} vehicles, " if isinstance(result.settings.get("vehicles"), int) else ""
    more = "--out writes all figures" if result.made else "result_markdown shows all figures"
    caption = f"{_caption([shown], short=True)} {more}. {vehicles}{_effort(result)}.{_failures(result)}"
    return Group(Text(result.experiment.title, style="bold"), table, Text(caption, style="dim"), Text())


def _failures(result: ExperimentResult) -> str:
    """Say where an optimisation failed; empty if none did."""
    failed = result.figures[(result.figures["figure"] == "failed") & (result.figures["value"] > 0.0)]
    named = [f"{row.series} {row.x:g} {row.method} {row.value:.3f}".strip() for row in failed.itertuples()]
    return f" Optimisation failed for a share of: {', '.join(named)}." if named else ""


def result_markdown(result: ExperimentResult, *, picture: str = "") -> str:
    """Result as a page (Markdown), with what is needed to repeat it.

    Parameters
    ----------
    result : ExperimentResult
        Of one experiment.
    picture : str
        File of its picture, as the page is to link it; empty: there is none.
    """
    experiment, figures, owner = result.experiment, result.figures, _owner(result)
    hidden = ("failed",) if experiment.deviations else ("failed", *COVERAGE)
    names = [name for name in FIGURES if name not in hidden and (figures["figure"] == name).any()]
    written = f"Written by `calibrator experiment {experiment.name} --out FOLDER`. " if result.made else ""
    more = _explained(name for name in names if name not in _shown(result))
    about = f"All figures{f'; besides those above {more}' if more else ''}."
    about += " After a stroke: the paper." if experiment.paper else ""
    if "harmed" in names and any(name.startswith("published/") for name in result.methods):
        about += (
            " The published method corrects every branch that it regresses, a sound one by what noise leaves there: "
            "such a vehicle counts as harmed although it is recovered."
        )
    sections = [f"# {experiment.title}", f"{written}{_caption([result])}{_failures(result)}"]
    sections += [_markdown(headline(result)), _together(result), f"![{experiment.title}]({picture})" if picture else ""]
    sections += [about, _details(result, names)]
    tenths = result.tenths[result.tenths["method"] == owner]
    whole = pool_tenths(tenths[tenths["series"] == ALL] if (tenths["series"] == ALL).any() else tenths)
    if len(whole):
        ece, chance = calibration_errors(whole)
        formats = {"low": "{:.1f}", "vehicles": "{:.0f}", "confidence": "{:.3f}", "recovered": "{:.3f}"}
        cells = pd.DataFrame({name: whole[name].map(text.format) for name, text in formats.items()})
        sections += [
            f"All settings together, by tenths of the confidence of {_called(owner)} (ECE {ece:.3f}, by "
            f"chance {chance:.3f}):",
            _markdown(cells.rename(columns={"low": "from", "confidence": "mean confidence"})),
        ]
    if experiment.deviations and len(tenths):
        pit = tenths.pivot_table(index=["series", "x"], columns="low", values="pit", sort=False, aggfunc="sum")
        pit.loc[(ALL, np.nan), :] = pit.sum()
        sections += [
            "Deployed parameters by tenths of their probability integral transform, which are equal if the posterior "
            "is right (of the simulation-based calibration these are its ranks):",
            _markdown(_labelled(pit.astype(int), experiment)),
        ]
    pairs = (
        (name, str(value).lower() if isinstance(value, bool) else value) for name, value in result.settings.items()
    )
    made = f" Made by {result.made}." if result.made else ""
    sections.append(f"Settings: {', '.join(f'{name} {value}' for name, value in pairs)}.{made}")
    return "\n\n".join(section for section in sections if section) + "\n"


def _markdown(table: pd.DataFrame) -> str:
    """Table as Markdown."""
    rows = (table.columns, ["---"] * table.shape[1], *table.to_numpy())
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in rows)


def _together(result: ExperimentResult) -> str:
    """All settings together: what is rare in one may be told by many; empty for a single setting."""
    own = result.figures[(result.figures["series"] != ALL) & result.figures["low"].notna()]
    own = own[own["figure"].isin(["harmed", "sure_wrong"])].method.unique()
    if result.figures[["series", "x"]].drop_duplicates().shape[0] < 2 or not len(own):
        return ""
    pooled = [
        pool_figures(result.figures[(result.figures["method"] == name) & (result.figures["series"] != ALL)]).assign(
            series="", x=0.0, method=name
        )
        for name in own
    ]
    table = _figure_table(pd.concat(pooled), ["harmed", "sure_wrong"], ["method"]).fillna(NOTHING)
    return _markdown(table.rename_axis("all settings together").reset_index())


def _details(result: ExperimentResult, names: Sequence[str]) -> str:
    """All figures of all methods, the paper's after a stroke."""
    return _markdown(_labelled(_figure_table(result.figures, names, KEYS, result.experiment), result.experiment))


def _figure_table(
    figures: pd.DataFrame, names: Sequence[str], index: list[str], experiment: Experiment | None = None
) -> pd.DataFrame:
    """A column of texts per figure."""
    texts, paper = _texts(figures), {} if experiment is None else experiment.paper
    texts["text"] += [
        f" / {paper[key][figure]:.2f}" if figure in paper.get(key := (x, method), {}) else ""
        for x, method, figure in zip(texts["x"], texts["method"], texts["figure"], strict=True)
    ]
    table = texts.pivot_table(index=index, columns="figure", values="text", sort=False, aggfunc="first")
    return table.reindex(columns=names).astype(object).set_axis([FIGURES[name].heading for name in names], axis=1)


def write_page(folder: Path, result: ExperimentResult) -> None:
    """Write NAME.json, NAME.md and NAME.png into a folder, and beside it the index ``FOLDER.md`` of all its results.

    Raises
    ------
    FleetError
        If another record of the folder is damaged.
    """
    name = result.experiment.name
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{name}.json", f"{result.to_json()}\n".encode())
    write_atomically(folder / f"{name}.md", result_markdown(result, picture=f"{name}.png").encode())
    write_picture(result, folder / f"{name}.png")
    results = [*read_records(folder, EXPERIMENTS), *([] if name in EXPERIMENTS else [result])]
    index = ["# Results of the experiments", f"Written by `calibrator experiment`. {_caption(results)}"]
    for each in results:
        row, made = each.experiment, f"; {each.made}" if each.made else ""
        index += [
            f"## [{row.title}]({folder.name}/{row.name}.md)",
            f"`calibrator experiment {row.name}`: {_effort(each)}{made}.",
            _markdown(headline(each)),
        ]
    write_atomically(folder.parent / f"{folder.name}.md", ("\n\n".join(index) + "\n").encode())


# ---- pictures: one function per kind; bars are 95 % intervals, rings the paper's figures

TITLES = {
    "recovery_rate": "recovery rate",
    "confidence": "mean confidence",
    "harmed": "harmed of the corrected",
    "named": "cause named",
    "gain_within_1": "gain errors within 1 sd",
    "offset_within_1": "offsets within 1 sd",
}
SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
LOGARITHMIC = 20.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic. [1]"""
MARGIN = 0.08
"""Of the range of values, left and right of them. [1]"""
DODGE_PT = 5.0
"""Curves stand side by side, so that equal ones do not hide each other. [pt]"""
FEW = 30
"""With fewer vehicles the share recovered is uncertain by more than about 0.1; their markers are hollow."""
COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#882255",
    "#999999",
    "#332288",
    "#117733",
    "#AA4499",
)
"""The first are those of Okabe and Ito, for all eyes."""
MARKERS, LINES = "os^DvPp<h>Xd", ("-", "--", "-.", ":")
METHODS = [method.name for method in (POSTERIOR, PERFECT, CEILING, TREE, THRESHOLD, LEFT_IN, *BASELINES)]
"""Each has its style in all pictures."""


def _style(of: int | str) -> dict[str, Any]:
    """How a curve, by its number, or a method is told from others, also without colours."""
    number = of if isinstance(of, int) else METHODS.index(of) if of in METHODS else len(METHODS)
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def write_picture(result: ExperimentResult, path: Path) -> None:
    """Draw a result into a PNG file."""
    draw_result(result).savefig(path, dpi=110)


def draw_result(result: ExperimentResult) -> Figure:
    """Draw a result of an experiment as its row in the table says, with one legend beside the data."""
    kinds = {"lines": _draw_lines, "dots": _draw_dots, "map": _draw_map, "reliability": _draw_reliability}
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(result.experiment.title)
    kinds[result.experiment.picture](figure, result)
    return figure


def _bars(rows: pd.DataFrame) -> Array:
    """Lengths of the 95 % intervals down and up, shape (2, n); 0 where there is none."""
    lengths = np.stack([rows["value"] - rows["low"], rows["high"] - rows["value"]])
    return np.asarray(np.maximum(np.nan_to_num(lengths), 0.0))


def _rings(
    axes: Axes,
    result: ExperimentResult,
    rows: pd.DataFrame,
    places: Iterable[float],
    *,
    label: str,
    colour: str,
    across: bool = False,
    **more: Any,
) -> None:
    """Figures of the paper for these rows, where it prints any: rings that hide nothing."""
    paper, keys = result.experiment.paper, zip(rows["x"], rows["method"], rows["figure"], strict=True)
    found = [paper.get((x, method), {}).get(figure) for x, method, figure in keys]
    known = [(place, value) for place, value in zip(places, found, strict=True) if value is not None]
    if known:
        x, y = zip(*(pair[::-1] if across else pair for pair in known), strict=True)
        look: dict[str, Any] = {"s": 110.0, "facecolors": "none", "edgecolors": colour, "linewidths": 1.5, "zorder": 4}
        axes.scatter(x, y, label=f"paper, {label}", **look, **more)


def _legend(figure: Figure, *, title: str | None = None) -> None:
    """One legend below all axes, each label once."""
    found: dict[str, Artist] = {}
    for axes in figure.axes:
        found = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True)) | found
    labels = sorted(found, key=lambda label: label.startswith("paper"))
    handles, columns = [found[label] for label in labels], min(len(labels), 6)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize="small", title=title)


def _draw_dots(figure: Figure, result: ExperimentResult) -> None:
    """A line of dots per setting and a panel per figure, where settings are no numbers."""
    table, panels, x_label = result.figures, result.experiment.panels, result.experiment.x_label
    keys = list(dict.fromkeys(zip(table["series"], table["x"], strict=True)))
    figure.set_size_inches(11.0, 2.0 + max(3.0, 0.3 * len(keys)))
    all_axes = figure.subplots(1, len(panels), sharey=True)
    for axes, name in zip(all_axes, panels, strict=True):
        for number, method in enumerate(result.methods):
            rows, style = table[(table["method"] == method) & (table["figure"] == name)], _style(method)
            aside = 0.6 * ((number + 0.5) / len(result.methods) - 0.5)
            place = [keys.index(key) + aside for key in zip(rows["series"], rows["x"], strict=True)]
            if place:
                bars = {"xerr": _bars(rows), "label": method, "linestyle": "", "markersize": 5.0}
                axes.errorbar(rows["value"], place, **bars, **style)
            _rings(axes, result, rows, place, label=method, colour=style["color"], across=True)
        axes.set(title=TITLES[name], xlim=SHARES)
        axes.grid(visible=True, alpha=0.3)
    ticks = [f"{series}, {x_label.split()[0]} {x:g}".removeprefix(", ") for series, x in keys]
    all_axes[0].set_yticks(range(len(keys)), ticks, fontsize="small")
    all_axes[0].invert_yaxis()
    _legend(figure)


def _draw_lines(figure: Figure, result: ExperimentResult) -> None:
    """Figures over what is varied: a curve per method; with several series a panel per method, a curve per series."""
    table, several = result.figures, result.figures["series"].nunique() > 1
    groups = [[method] for method in result.methods] if several else [list(result.methods)]
    drawn = [
        (name, group, panel)
        for name in result.experiment.panels
        for group in groups
        if len(panel := table[(table["figure"] == name) & table["method"].isin(group)])
    ]
    all_axes, values = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0], sorted(set(table["x"]))
    for axes, (name, group, panel) in zip(all_axes, drawn, strict=True):
        curves = list(panel.groupby(["method", "series"], sort=False))
        for number, ((method, one), rows) in enumerate(curves):
            label, style = ((one or "as S says"), _style(number)) if several else (method, _style(method))
            aside_pt = DODGE_PT * (number - (len(curves) - 1) / 2.0)
            transform = axes.transData + ScaledTranslation(aside_pt / 72.0, 0.0, figure.dpi_scale_trans)
            axes.errorbar(
                rows["x"],
                rows["value"],
                yerr=_bars(rows),
                label=label,
                transform=transform,
                linestyle=LINES[number % len(LINES)],
                markersize=5.5,
                capsize=2.5,
                elinewidth=1.0,
                **style,
            )
            _rings(axes, result, rows, rows["x"], label=label, colour=style["color"], transform=transform)
        axes.set(title=f"{TITLES[name]}, {group[0]}" if several else TITLES[name], ylim=SHARES)
        axes.set_xlabel(result.experiment.x_label)
        axes.tick_params(labelleft=True)
        axes.grid(visible=True, alpha=0.3)
        margin = MARGIN * (values[-1] - values[0]) or 1.0
        axes.set_xlim(values[0] - margin, values[-1] + margin)
        if values[0] > 0.0 and values[-1] > LOGARITHMIC * values[0]:
            factor = (values[-1] / values[0]) ** MARGIN
            axes.set(xscale="log", xlim=(values[0] / factor, values[-1] * factor))
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.set_xticks([], minor=True)
    all_axes[0].set_ylabel("share of vehicles; bars: 95 % intervals")
    _legend(figure, title=result.experiment.series_label if several else None)


def _draw_map(figure: Figure, result: ExperimentResult) -> None:
    """A map of the recovery rate per method."""
    table, experiment = result.figures, result.experiment
    all_axes = np.atleast_1d(figure.subplots(1, len(result.methods)))
    for axes, method in zip(all_axes, result.methods, strict=True):
        rates = table[(table["method"] == method) & (table["figure"] == "recovery_rate")]
        grid = rates.pivot_table(index="series", columns="x", values="value", sort=False).sort_index(axis=1)
        axes.imshow(grid, vmin=0.0, vmax=1.0, origin="lower", aspect="auto", cmap="viridis")
        for (i, j), rate in np.ndenumerate(grid.to_numpy()):
            axes.text(j, i, f"{rate:.2f}", ha="center", va="center", color="black" if rate > 0.6 else "white")
        axes.set_xticks(range(grid.shape[1]), [f"{x:g}" for x in grid.columns])
        axes.set_yticks(range(len(grid)), grid.index)
        axes.set(title=f"recovery rate, {method}", xlabel=experiment.x_label, ylabel=experiment.series_label)


def _draw_reliability(figure: Figure, result: ExperimentResult) -> None:
    """Share recovered over confidence, experiment by experiment and all together, with the numbers of vehicles."""
    reliability, counts = figure.subplots(1, 2)
    reliability.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0)
    errors = result.figures[result.figures["figure"] == "ece"].set_index("series")["value"]
    for number, (series, tenths) in enumerate(result.tenths.groupby("series", sort=False)):
        label = f"{series}, ECE {errors[series]:.3f}"
        if series == ALL:
            reliability.plot(tenths["confidence"], tenths["recovered"], "k.-", label=label)
            bars = counts.bar(tenths["low"] + 0.05, tenths["vehicles"], width=0.09, color="0.6")
            counts.bar_label(bars, fontsize="x-small")
            counts.set_ylim(0.8, 3.0 * tenths["vehicles"].max())
            continue
        style = _style(number)
        reliability.plot([], [], linestyle="", label=label, **style)
        for tenth in tenths.itertuples():
            face = style["color"] if tenth.vehicles >= FEW else "white"
            reliability.plot(tenth.confidence, tenth.recovered, linestyle="", markerfacecolor=face, **style)
    reliability.plot([], [], "o", color="0.6", markerfacecolor="white", label=f"hollow: fewer than {FEW} vehicles")
    reliability.set(xlabel="confidence", ylabel="share recovered", xlim=SHARES, ylim=SHARES)
    reliability.grid(visible=True, alpha=0.3)
    counts.set(xlabel="confidence", ylabel=f"vehicles, {ALL}", yscale="log", xlim=SHARES)
    _legend(figure)
