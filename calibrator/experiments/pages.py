"""Results of experiments as tables on the console, and as pages with their pictures in a folder."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import color_sequences
from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table
from rich.text import Text

from calibrator.experiments.experiments import ALL, EXPERIMENTS, KEYS, Experiment, ExperimentResult
from calibrator.experiments.figures import FIGURES
from calibrator.experiments.methods import POSTERIOR
from calibrator.terminal.text import counted
from ecu_node.documents import write_atomically

__all__ = ["draw_result", "figure_table", "headline", "result_markdown", "result_table", "write_page"]

CONSOLE = {"recovery_rate", "confidence", "harmed"}
"""Figures for which a console of 80 columns has room, besides those of the picture."""
SHARES = (-0.03, 1.03)
"""Axis of a share: 0 to 1, with room for the markers at its ends. [1]"""
COLOURS, MARKERS = (*color_sequences["tab10"], "black", "grey"), "os^DvPp<h>Xd"


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
        figures[rates].pivot(index=["series", "x"], columns="method", values="text").reindex(columns=result.methods),
        figures[own].pivot(index=["series", "x"], columns="figure", values="text")[shown],
    ]
    table = pd.concat(parts, axis=1).reindex(settings)
    if experiment.paper:  # the paper's best figure, whichever methods were run
        best = dict(sorted((x, found["recovery_rate"]) for (x, _), found in experiment.paper.items()))
        table.insert(0, "paper", [f"{best[x]:.2f}" if x in best else None for _, x in table.index])
    return _labelled(table, experiment)


def figure_table(result: ExperimentResult, names: Iterable[str], *, intervals: bool = True) -> pd.DataFrame:
    """Return a table of texts, a row per setting and method, a column per figure of `names`.

    A text is ``0.937 (0.921 to 0.950) / 0.91``: value, interval (if `intervals`), value of the paper (if it has one).
    """
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
    table["x"] = ["all" if np.isnan(x) else f"{x:g}" for x in table["x"]]
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


def _effort(result: ExperimentResult) -> str:
    """Return as a sentence: repetitions, seed and drive of a result, and the version and machine that made it."""
    settings, made = result.settings, f"; {result.made}" if result.made else ""
    times = counted(int(settings["repetitions"]), "repetition")
    return f"{times}, seed {settings['seed']}, drive {settings['drive']}{made}."


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
    caption = f"{_explained(names)}. {result.experiment.note} {_effort(result)}"
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
    sections = [
        f"# {experiment.title}",
        f"`calibrator experiment {experiment.name}`: {_effort(result)}",
        _markdown(headline(result)),
        f"![{experiment.title}]({picture})" if picture else "",
        "The table shows the share of vehicles recovered within 10 %, by method, with 95 % intervals"
        + (f"; then figures of {owner}." if owner else "."),
        experiment.note,
        f"All figures{'; after a stroke the paper' if experiment.paper else ''}. {_explained(names)}.",
        _markdown(figure_table(result, names)),
    ]
    tenths = result.tenths[result.tenths["method"] == owner].tail(10)  # the last ten are those of all settings
    if len(tenths):
        formats = {
            "low": "{:.1f}",
            "vehicles": "{:.0f}",
            "confidence": "{:.3f}",
            "recovered": "{:.3f}",
            "pit": "{:.0f}",
        }
        cells = pd.DataFrame({name: tenths[name].map(text.format) for name, text in formats.items()})
        sections += [
            f"Tenths of the confidence of {owner}, all settings together; pit: deployed parameters by tenths of their "
            "probability integral transform, equally many if the posterior is right:",
            _markdown(cells),
        ]
    sections.append(f"Settings: {', '.join(f'{name} {value}' for name, value in result.settings.items())}.")
    return "\n\n".join(section for section in sections if section) + "\n"


def _markdown(table: pd.DataFrame) -> str:
    rows = (table.columns, ["---"] * table.shape[1], *table.to_numpy())
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in rows)


def write_page(folder: Path, result: ExperimentResult) -> None:
    """Write NAME.json, NAME.md and NAME.png into a folder, and beside it FOLDER.md with the tables of all its pages."""
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
    for other in dict.fromkeys([*EXPERIMENTS, name]):
        if (page := folder / f"{other}.md").is_file():
            head, _, _ = page.read_text().partition("\n\n![")  # all above the picture
            title, _, rest = head.removeprefix("# ").partition("\n\n")
            index += [f"## [{title}]({folder.name}/{other}.md)", rest]
    write_atomically(folder.parent / f"{folder.name}.md", ("\n\n".join(index) + "\n").encode())


def draw_result(result: ExperimentResult) -> Figure:
    """Draw a panel per figure of a result: a line per setting, with a dot per method in it.

    Bars are 95 % intervals, rings the paper's figures.
    """
    table, experiment = result.figures, result.experiment
    settings = table[["series", "x"]].drop_duplicates().itertuples(index=False)
    labels = [_setting_label(experiment, *setting) for setting in settings]
    figure = Figure(figsize=(11.0, 2.0 + max(3.0, 0.3 * len(labels))), layout="constrained")
    figure.suptitle(experiment.title)
    (all_axes,) = figure.subplots(1, len(experiment.panels), sharey=True, squeeze=False)
    handles = {}
    for axes, name in zip(all_axes, experiment.panels, strict=True):
        for number, method in enumerate(result.methods):
            rows = table[(table["method"] == method) & (table["figure"] == name)]
            beside = 0.6 * ((number + 0.5) / len(result.methods) - 0.5)  # the methods of a setting stand side by side
            place = [labels.index(_setting_label(experiment, row.series, row.x)) + beside for row in rows.itertuples()]
            lengths = np.maximum(np.nan_to_num([rows["value"] - rows["low"], rows["high"] - rows["value"]]), 0.0)
            style: dict[str, Any] = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}
            handles[method] = axes.errorbar(rows["value"], place, xerr=lengths, linestyle="", **style)
            paper = np.array([_of_paper(experiment, row) for row in rows.itertuples()])
            if np.isfinite(paper).any():
                ring = {"s": 110.0, "facecolors": "none", "edgecolors": style["color"], "zorder": 4}
                handles[f"paper, {method}"] = axes.scatter(paper, place, **ring)
        axes.set(title=name.replace("_", " "), xlim=SHARES)
        axes.grid(visible=True, alpha=0.3)
    all_axes[0].set_yticks(range(len(labels)), labels, fontsize="small")
    all_axes[0].invert_yaxis()
    columns = min(len(handles), 6)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, fontsize="small")
    return figure


def _setting_label(experiment: Experiment, series: str, x: float) -> str:
    """Return what a picture calls a setting, such as ``K=2, 5-25 %, sparsity 80``."""
    return ALL if np.isnan(x) else f"{series}, {experiment.x_label.split()[0]} {x:g}".removeprefix(", ")
