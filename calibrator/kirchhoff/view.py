"""Text, picture and table of a Kirchhoff comparison."""

import html
import io
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.kirchhoff.sums import BAND, SUM, Comparison
from calibrator.terminal.text import figure, table
from ecu_node.documents import write_atomically

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["draw_kirchhoff", "kirchhoff_text", "save_table"]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#999999")
"""Okabe and Ito's colours, which colour-blind readers can tell apart; black is kept for the sum."""
_BAND_COLOUR = "#D9D9D9"
_SUMS = {"before": "black", "after": _COLOURS[1]}
_ENDS = {"before": "_a", "after": "_corrected_a"}
"""Ends of the names of columns."""
_Panels = list[tuple[str, list[tuple[str, str, str]]]]
"""Diagrams from top to bottom: title, and name, column and colour of each line; the band belongs to the last one."""
SLIP = 0.5
"""Magnitude of a gain error beyond which it is no sensor's but a slip of sign or unit. [1]"""
LEAST_SHARE = 0.005
"""Of how the sum varies: less stands as 0 % and explains nothing. [1]"""
MOST_DRAWN = 50_000
"""Instants: more make a page of tens of megabytes, and no line that could be seen. [1]"""


def kirchhoff_text(comparison: Comparison, notices: Sequence[str]) -> str:
    """Tables of 80 columns, notices, and the line that sums it up."""
    stages = {stage: found for stage, found in comparison.figures.items() if stage != "change"}
    keys = ["RMSE", "max", "mean", "sd"]
    header = ["", *(word for stage in stages for word in (stage, "", "", ""))]
    rows = [
        (name, *(f"{value:.2f}" for found in stages.values() for value in found[name]))
        for name in (*comparison.branches, SUM)
    ]
    parts = ", ".join(f"{name} {figure(value, 2)}" for name, value in comparison.parts_a.items() if value >= 0.001)
    lines = [
        "Currents [A], positive into the junction",
        table(header, [("", *keys * len(stages)), *rows]),
        "",
        f"right sensors would sum to {figure(comparison.expected_a)} +- {figure(comparison.usual_sd_a, 2)} A"
        + (f" ({parts})" if parts else ""),
        f"within {BAND:g} sd of that: {_inside(comparison)} of the instants",
    ]
    for stage, residual in comparison.residual.items():
        if residual is not None:
            shares = (f"{name} {_percent(getattr(residual, name))}" for name in ("constant", "gains", "delays", "rest"))
            lines.append(f"of the sum {stage} (mean square): {', '.join(shares)} ({figure(residual.rest_a, 2)} A)")
    last = list(comparison.residual.values())[-1]
    if last is not None and any(own.gain_share > LEAST_SHARE for own in last.alone.values()):
        rows = [
            (name, f"{100.0 * own.gain_error:+.1f} %" if abs(own.gain_error) <= SLIP else "-", _percent(own.gain_share))
            for name, own in last.alone.items()
        ]
        title = "What the gain of one branch alone could explain of how the sum varies"
        lines += ["", title, table(["", "gain error", "explains"], rows), ""]
    total = f"RMSE of the sum: {(before_a := stages['before'][SUM].rmse_a):.2f} A before"
    if "after" in stages:
        after_a = stages["after"][SUM].rmse_a
        ratio = f", {figure(before_a / after_a, 2)} times less" if 0.0 < after_a < before_a else ""
        total += f", {after_a:.2f} A after{ratio}"
    return "\n".join([*lines, *notices, f"{total} ({comparison.full_scale_a:g} A full scale)"])


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _inside(comparison: Comparison) -> str:
    return ", ".join(f"{stage} {_percent(share)}" for stage, share in comparison.in_band.items())


def draw_kirchhoff(comparison: Comparison, path: Path, *, title: str) -> None:
    """Draw all branch currents and their sum over time, and the sum with its band.

    Parameters
    ----------
    comparison : Comparison
        What is compared; one panel before and, where there are corrected currents, one after.
    path : Path
        Picture to write, .png, .pdf, .svg, or .html, which is a page that needs no other file.
    title : str
        Stands above the panels.

    Raises
    ------
    DriveError
        If it cannot be written.
    """
    frame = _frame(comparison)
    every = -(-len(frame) // MOST_DRAWN)
    if every > 1:
        title, frame = f"{title} (1 instant of {every})", frame.iloc[::every]
    panels: _Panels = []
    for stage, found in comparison.figures.items():
        if stage in _ENDS:
            rmse_a, end = found[SUM].rmse_a, _ENDS[stage]
            share = f"{100.0 * rmse_a / comparison.full_scale_a:.2f} % of full scale"
            lines = [(name, f"{name}{end}", colour) for name, colour in zip(comparison.branches, cycle(_COLOURS))]
            panels.append(
                (f"{stage}: RMSE of the sum {rmse_a:.2f} A = {share}", [*lines, ("sum of all", SUM + end, "black")])
            )
    sums = [(f"sum {stage}", SUM + _ENDS[stage], _SUMS[stage]) for stage in comparison.currents_a]
    panels.append((f"sum, and band of right sensors (in it: {_inside(comparison)})", sums))
    band = [comparison.expected_a + side * BAND * frame["expected_sd_a"] for side in (-1.0, 1.0)]
    is_page = path.suffix.lower() == ".html"
    _write(path, (_page if is_page else _picture)(panels, frame, band, title, path.suffix.lower()[1:]), "picture")


def _picture(
    panels: _Panels, frame: "pd.DataFrame", band: "Sequence[pd.Series[float]]", title: str, form: str
) -> bytes:
    import matplotlib as mpl  # noqa: PLC0415 (half a second, of no use for a page)
    from matplotlib.figure import Figure  # noqa: PLC0415

    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True}):
        drawing = Figure(figsize=(8.0, 1.0 + 2.5 * len(panels)), layout="constrained")
        all_axes = drawing.subplots(len(panels), sharex=True)
        all_axes[-1].fill_between(frame.index, *band, color=_BAND_COLOUR, linewidth=0, label="expected")
        all_axes[-1].set_xlabel("time [s]")
        for axes, (heading, lines) in zip(all_axes, panels, strict=True):
            for name, column, colour in lines:
                axes.plot(frame.index, frame[column], color=colour, linewidth=0.9, label=name)
            axes.set_title(heading, loc="left", fontsize=9)
            axes.set_ylabel("current [A]")
            axes.margins(x=0.0)
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        drawing.suptitle(title, fontsize=10)
        content = io.BytesIO()
        drawing.savefig(content, format=form, dpi=150)
    return content.getvalue()


def _page(panels: _Panels, frame: "pd.DataFrame", band: "Sequence[pd.Series[float]]", title: str, _form: str) -> bytes:
    from plotly.subplots import make_subplots  # noqa: PLC0415 (of no use for a picture)

    rows = len(panels)
    drawing = make_subplots(rows, shared_xaxes=True, vertical_spacing=0.07, subplot_titles=[text for text, _ in panels])
    edge = {"x": frame.index, "line_width": 0, "hoverinfo": "skip", "row": rows, "col": 1}
    drawing.add_scatter(y=band[0], showlegend=False, **edge)
    drawing.add_scatter(y=band[1], fill="tonexty", fillcolor=_BAND_COLOUR, name="expected", **edge)
    for row, (_, lines) in enumerate(panels, start=1):
        for name, column, colour in lines:
            style = {"line": {"color": colour, "width": 1.2}, "legendgroup": name, "showlegend": row in {1, rows}}
            drawing.add_scatter(x=frame.index, y=frame[column], name=name, **style, row=row, col=1)
    drawing.update_yaxes(title_text="current [A]")
    drawing.update_xaxes(title_text="time [s]", row=rows, col=1)
    drawing.update_layout(
        title={"text": title.replace(": ", ":<br>", 1), "font_size": 15},
        template="plotly_white",
        hovermode="x unified",
        height=180 + 280 * rows,
        legend={"orientation": "h", "y": -0.12},
        margin={"l": 60, "r": 15},
    )
    drawing.update_annotations(x=0.0, xanchor="left", font_size=12)
    page = drawing.to_html(include_plotlyjs=True, config={"displaylogo": False, "responsive": True})
    head = f'<head><title>{html.escape(title)}</title><meta name="viewport" content="width=device-width">'
    return str(page).replace("<head>", head, 1).encode()


def save_table(comparison: Comparison, path: Path) -> None:
    """Write the currents for a spreadsheet.

    Parameters
    ----------
    comparison : Comparison
        What is compared.
    path : Path
        File to write, .csv or .parquet: time_s, a column per branch and the sum [A], the same with ``_corrected`` where
        something is corrected, and the standard deviation expected of the sum; empty where not valid.

    Raises
    ------
    DriveError
        If it cannot be written.
    """
    frame, is_csv = _frame(comparison).reset_index().round(6), path.suffix.lower() == ".csv"
    _write(path, frame.to_csv(index=False).encode() if is_csv else frame.to_parquet(None, index=False), "table")


def _frame(comparison: Comparison) -> "pd.DataFrame":
    """Currents and their sum over time_s, and what is expected of the sum; not a number where not valid."""
    import pandas as pd  # noqa: PLC0415 (half a second, of no use for the text alone)

    columns: dict[str, Array] = {}
    for stage, currents_a in comparison.currents_a.items():
        names = (f"{name}{_ENDS[stage]}" for name in (*comparison.branches, SUM))
        columns |= dict(zip(names, (*currents_a.T, currents_a.sum(axis=1)), strict=True))
    columns["expected_sd_a"] = comparison.expected_sd_a
    frame = pd.DataFrame(columns, index=pd.Index(comparison.time_s, name="time_s"))
    frame.loc[~comparison.valid] = float("nan")
    return frame


def _write(path: Path, content: bytes, what: str) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        raise DriveError(f"{path}: cannot write the {what}: {error.strerror}; choose another folder") from None
