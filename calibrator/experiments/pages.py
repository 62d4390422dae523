"""Results of experiments as tables on the console, and as pages with their pictures in a folder."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table
from rich.text import Text

from calibrator.experiments.experiments import COVERAGE, EXPERIMENTS, KEYS, Experiment, ExperimentResult, read_records
from calibrator.experiments.figures import ALL, FIGURES, calibration_errors, pool_tenths
from calibrator.experiments.methods import POSTERIOR
from calibrator.terminal.text import counted
from ecu_node.documents import write_atomically

__all__ = ["draw_result", "figure_table", "headline", "result_markdown", "result_table", "write_page"]

CONSOLE = {"recovery_rate", "confidence", "harmed"}
"""Figures for which a console of 80 columns has room, besides those of the picture."""


def headline(result: ExperimentResult) -> pd.DataFrame:
    """Return a table of texts: recovery of the paper and of all methods side by side, then figures of the default.

    It has a row per setting. Where the default was not run, the figures after the recovery are those of the first
    method with a confidence.
    """
    figures, experiment = result.figures.assign(text=_texts(result)), result.experiment
    rates, own = figures["figure"] == "recovery_rate", figures["method"] == _owner(result)
    shown = [name for name in experiment.shown if (figures.loc[own, "figure"] == name).any()]
    settings = pd.MultiIndex.from_frame(figures[["series", "x"]].drop_duplicates())
    parts = [
        figures[rates].pivot(index=["series", "x"], columns="method", values="text").reindex(columns=result.methods)
    ]
    parts += [figures[own].pivot(index=["series", "x"], columns="figure", values="text")[shown]]
    table = pd.concat(parts, axis=1).reindex(settings)
    if experiment.paper:  # the paper's best figure, whichever methods were run
        best = dict(sorted((x, found["recovery_rate"]) for (x, _), found in experiment.paper.items()))
        table.insert(0, "paper", [f"{best[x]:.2f}" if x in best else None for _, x in table.index])
    return _labelled(table, experiment)


def figure_table(result: ExperimentResult, names: Iterable[str], *, intervals: bool = True) -> pd.DataFrame:
    """Return figures of all methods as texts, a row per setting and method; the paper's value follows a slash."""
    figures = result.figures.assign(text=_texts(result, intervals=intervals))
    paper = (_of_paper(result.experiment, row) for row in figures.itertuples())
    figures["text"] += [f" / {value:.2f}" if np.isfinite(value) else "" for value in paper]
    rows = pd.MultiIndex.from_frame(figures[KEYS].drop_duplicates())
    table = figures.pivot(index=KEYS, columns="figure", values="text").reindex(index=rows, columns=names)
    return _labelled(table, result.experiment)


def _texts(result: ExperimentResult, *, intervals: bool = True) -> list[str]:
    """Format each row of figures: ``0.937 (0.921 to 0.950)``, and for a rare one its counts: ``; 2 of 140``."""
    texts = []
    for row in result.figures.itertuples():
        count = f"; {round(row.value * row.of)} of {row.of:.0f}" if FIGURES[row.figure].rare else ""
        between = f" ({row.low:.3f} to {row.high:.3f}{count})" if intervals and np.isfinite(row.low) else ""
        texts.append(f"{row.value:.3f}{between}")
    return texts


def _of_paper(experiment: Experiment, row: Any) -> float:
    """Return the value that the paper prints for a row of figures; NaN if there is none."""
    return experiment.paper.get((row.x, row.method), {}).get(row.figure, float("nan"))


def _labelled(table: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Turn the index of a table (series, x) into columns with the experiment's labels; drop series without a label."""
    table = table.astype(object).fillna("-").reset_index()
    table["x"] = ["" if np.isnan(x) else f"{x:g}" for x in table["x"]]
    table = table if experiment.series_label else table.drop(columns="series")
    labels = {name: name.replace("_", " ") for name in FIGURES}
    return table.rename(columns=labels | {"series": experiment.series_label, "x": experiment.x_label})


def _owner(result: ExperimentResult) -> str:
    """Return the method whose confidence is shown: the default, else the first that has one; empty if none has."""
    confident = result.figures.loc[result.figures["figure"] == "confidence", "method"].tolist()
    return POSTERIOR.name if POSTERIOR.name in confident else next(iter(confident), "")


def _names(result: ExperimentResult) -> list[str]:
    """Return the names of a result's figures, in the order of :data:`FIGURES`; ``failed`` only if it is not 0."""
    there = result.figures[(result.figures["figure"] != "failed") | (result.figures["value"] > 0.0)]["figure"]
    return [name for name in FIGURES if (there == name).any()]


def _notes(result: ExperimentResult) -> str:
    """Return the experiment's note, and which branch is minus the sum of the others."""
    branch = result.settings.get("balance_branch")
    balance = f"In every trip the current of {branch} is minus the sum of the others, so it depends on their sensors."
    return f"{result.experiment.note} {balance if branch else ''}".strip()


def _effort(result: ExperimentResult) -> str:
    settings = result.settings
    count = settings["repetitions"]
    times = counted(count, "repetition") if isinstance(count, int) else f"{count} repetitions"
    return f"{times}, seed {settings['seed']}, drive {settings['drive']}"


def _explained(names: Iterable[str]) -> str:
    return "; ".join(f"{name.replace('_', ' ')}: {FIGURES[name].meaning}" for name in names)


def result_table(result: ExperimentResult) -> Group:
    """Return the main figures of all methods for the console: title, table and what its columns mean."""
    names = [name for name in _names(result) if name in CONSOLE | {*result.experiment.panels}]
    table, cells = Table(box=None, pad_edge=False, collapse_padding=True), figure_table(result, names, intervals=False)
    for heading in cells.columns:
        text = heading in {"method", result.experiment.series_label}
        table.add_column(Text(heading), justify="left" if text else "right", no_wrap=text, overflow="fold")
    for row in cells.to_numpy():
        table.add_row(*map(Text, row))
    caption = f"{_explained(names)}. {_notes(result)} {_effort(result)}."
    return Group(Text(result.experiment.title, style="bold"), table, Text(caption, style="dim"), Text())


def result_markdown(result: ExperimentResult, *, picture: str = "") -> str:
    """Return a result as a page (Markdown), with the settings that repeat it.

    Parameters
    ----------
    result : ExperimentResult
        Result of one experiment.
    picture : str
        Link to the file of its picture; empty: there is none.
    """
    experiment, names, owner = result.experiment, _names(result), _owner(result)
    also = f"; then figures of {owner}" if owner else ""
    written = f"Written by `calibrator experiment {experiment.name} --out FOLDER`." if result.made else ""
    sections = [
        f"# {experiment.title}",
        f"{written} {_notes(result)}".strip(),
        f"Share of vehicles recovered within 10 %, by method, with 95 % intervals{also}:",
        _markdown(headline(result)),
        f"![{experiment.title}]({picture})" if picture else "",
        f"All figures{'; after a stroke the paper' if experiment.paper else ''}. {_explained(names)}.",
        _markdown(figure_table(result, names)),
    ]
    tenths = result.tenths[result.tenths["method"] == owner]
    whole = pool_tenths(tenths[tenths["series"] == ALL] if (tenths["series"] == ALL).any() else tenths)
    if len(whole):
        ece, chance = calibration_errors(whole)
        formats = {"low": "{:.1f}", "vehicles": "{:.0f}", "confidence": "{:.3f}", "recovered": "{:.3f}"}
        cells = pd.DataFrame({name: whole[name].map(text.format) for name, text in formats.items()})
        sections += [f"Tenths of the confidence of {owner}, ECE {ece:.3f}, by chance {chance:.3f}:", _markdown(cells)]
    if experiment.shown == COVERAGE and len(tenths):
        pit = tenths.pivot_table(index=["series", "x"], columns="low", values="pit", sort=False, aggfunc="sum")
        pit.loc[(ALL, np.nan), :] = pit.sum()
        sections += [
            "Deployed parameters by tenths of their probability integral transform, equal if the posterior is right:",
            _markdown(_labelled(pit.astype(int), experiment)),
        ]
    made = f" Made by {result.made}." if result.made else ""
    sections.append(f"Settings: {', '.join(f'{name} {value}' for name, value in result.settings.items())}.{made}")
    return "\n\n".join(section for section in sections if section) + "\n"


def _markdown(table: pd.DataFrame) -> str:
    rows = (table.columns, ["---"] * table.shape[1], *table.to_numpy())
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in rows)


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
    draw_result(result).savefig(folder / f"{name}.png", dpi=110)
    index = [
        "# Results of the experiments",
        "Written by `calibrator experiment`. Share of vehicles recovered within 10 %, by method, with 95 % intervals; "
        "then figures of the default. Each page says what its columns are.",
    ]
    for each in [*read_records(folder, EXPERIMENTS), *([] if name in EXPERIMENTS else [result])]:
        row, made = each.experiment, f"; {each.made}" if each.made else ""
        index += [
            f"## [{row.title}]({folder.name}/{row.name}.md)",
            f"`calibrator experiment {row.name}`: {_effort(each)}{made}.",
            _markdown(headline(each)),
        ]
    write_atomically(folder.parent / f"{folder.name}.md", ("\n\n".join(index) + "\n").encode())


# ---- pictures: one function per kind; bars are 95 % intervals, rings the paper's figures

SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
FEW = 30
"""With fewer vehicles the share recovered is uncertain by more than about 0.1."""
COLOURS = (*color_sequences["tab10"], "black", "grey")
MARKERS, LINES = "os^DvPp<h>Xd", ("-", "--", "-.", ":")


def draw_result(result: ExperimentResult) -> Figure:
    """Draw a result of an experiment as its row in the table says, with one legend below all axes."""
    kinds = {"lines": _draw_lines, "dots": _draw_dots, "map": _draw_map, "reliability": _draw_reliability}
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    figure.suptitle(result.experiment.title)
    kinds[result.experiment.picture](figure, result)
    found = {label: item for axes in figure.axes for item, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if found:
        figure.legend(
            found.values(), found.keys(), loc="outside lower center", ncols=min(len(found), 6), fontsize="small"
        )
    return figure


def _style(number: int) -> dict[str, Any]:
    """Return colour and marker of a curve; it differs from others without colours, too."""
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def _draw_points(
    axes: Axes, experiment: Experiment, rows: pd.DataFrame, places: Sequence[float], *, label: str, number: int, of: int
) -> None:
    """Draw curve ``number`` of ``of``, shifted to stand beside the others at the places of its settings.

    In a picture of dots the settings go from top to bottom and values to the right; else settings go to the right.
    """
    across = experiment.picture == "dots"
    place = np.array(places) + (0.6 if across else 0.2) * ((number + 0.5) / of - 0.5)
    lengths = np.maximum(np.nan_to_num([rows["value"] - rows["low"], rows["high"] - rows["value"]]), 0.0)
    paper = np.array([_of_paper(experiment, row) for row in rows.itertuples()])
    ring: dict[str, Any] = {"s": 110.0, "facecolors": "none", "edgecolors": _style(number)["color"], "zorder": 4}
    if across:
        axes.errorbar(rows["value"], place, xerr=lengths, label=label, linestyle="", **_style(number))
    else:
        line = LINES[number % len(LINES)]
        axes.errorbar(place, rows["value"], yerr=lengths, label=label, linestyle=line, capsize=2.5, **_style(number))
    if np.isfinite(paper).any():
        axes.scatter(*((paper, place) if across else (place, paper)), label=f"paper, {label}", **ring)


def _draw_dots(figure: Figure, result: ExperimentResult) -> None:
    """Draw a panel per figure, with a line per setting and a dot per method in it."""
    table, experiment = result.figures, result.experiment
    keys = list(dict.fromkeys(zip(table["series"], table["x"], strict=True)))
    figure.set_size_inches(11.0, 2.0 + max(3.0, 0.3 * len(keys)))
    all_axes = figure.subplots(1, len(experiment.panels), sharey=True)
    for axes, name in zip(all_axes, experiment.panels, strict=True):
        for number, method in enumerate(result.methods):
            rows = table[(table["method"] == method) & (table["figure"] == name)]
            places = [keys.index(key) for key in zip(rows["series"], rows["x"], strict=True)]
            if places:
                _draw_points(axes, experiment, rows, places, label=method, number=number, of=len(result.methods))
        axes.set(title=name.replace("_", " "), xlim=SHARES)
        axes.grid(visible=True, alpha=0.3)
    ticks = [f"{series}, {experiment.x_label.split()[0]} {x:g}".removeprefix(", ") for series, x in keys]
    all_axes[0].set_yticks(range(len(keys)), ticks, fontsize="small")
    all_axes[0].invert_yaxis()


def _draw_lines(figure: Figure, result: ExperimentResult) -> None:
    """Draw figures over what is varied: a curve per method, or for several series a panel per method."""
    table, experiment = result.figures, result.experiment
    several, values = table["series"].nunique() > 1, sorted(set(table["x"]))
    groups = [[method] for method in result.methods] if several else [list(result.methods)]
    curves = list(dict.fromkeys(table["series"])) if several else result.methods
    panels = {
        (name, group[0]): table[(table["figure"] == name) & table["method"].isin(group)]
        for name in experiment.panels
        for group in groups
    }
    panels = {key: panel for key, panel in panels.items() if len(panel)}
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, ((name, method), panel) in zip(all_axes, panels.items(), strict=True):
        for number, one in enumerate(curves):
            rows = panel[panel["series" if several else "method"] == one]
            if places := [values.index(x) for x in rows["x"]]:
                label = f"{experiment.series_label} {one or 'as S says'}" if several else one
                _draw_points(axes, experiment, rows, places, label=label, number=number, of=len(curves))
        title = name.replace("_", " ")
        axes.set(title=f"{title}, {method}" if several else title, xlabel=experiment.x_label, ylim=SHARES)
        axes.set_xticks(range(len(values)), [f"{value:g}" for value in values])
        axes.grid(visible=True, alpha=0.3)
    all_axes[0].set_ylabel("share of vehicles; bars: 95 % intervals")


def _draw_map(figure: Figure, result: ExperimentResult) -> None:
    """Draw a map of the recovery rate for each method."""
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
    """Draw the share recovered over the confidence, by experiment and all together, with the numbers of vehicles."""
    reliability, counts = figure.subplots(1, 2)
    reliability.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0)
    errors = result.figures[result.figures["figure"] == "ece"].set_index("series")["value"]
    for number, (series, tenths) in enumerate(result.tenths.groupby("series", sort=False)):
        known, style = tenths[tenths["vehicles"] >= FEW], {**_style(number), "linestyle": ""}
        if series == ALL:
            style = {"color": "black", "marker": ".", "linestyle": "-"}
            bars = counts.bar(tenths["low"] + 0.05, tenths["vehicles"], width=0.09, color="0.6")
            counts.bar_label(bars, fontsize="x-small")
            counts.set_ylim(0.8, 3.0 * tenths["vehicles"].max())
        label = f"{series}, ECE {errors[series]:.3f}"
        reliability.plot(known["confidence"], known["recovered"], label=label, **style)
    reliability.set(xlabel=f"confidence, tenths with at least {FEW} vehicles", ylabel="share recovered")
    reliability.set(xlim=SHARES, ylim=SHARES)
    reliability.grid(visible=True, alpha=0.3)
    counts.set(xlabel="confidence", ylabel=f"vehicles, {ALL}", yscale="log", xlim=SHARES)
