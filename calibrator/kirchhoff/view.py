"""Text, JSON, picture and table of a Kirchhoff comparison."""

import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from calibrator.drive import Array
from calibrator.drives.delays import MAX_DELAY_S
from calibrator.errors import DriveError
from calibrator.kirchhoff.sums import BAND, SUM, Comparison
from calibrator.terminal.text import dumps, figure
from ecu_node.user_files import write_atomically

__all__ = ["draw_kirchhoff", "kirchhoff_json", "kirchhoff_text", "save_table"]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#999999")
"""Okabe and Ito's colours, which colour-blind readers can tell apart; black is kept for the sum."""
_BAND_COLOUR = "#D9D9D9"
SLIP = 0.5
"""Magnitude of a gain error beyond which it is no sensor's but a slip of sign or unit. [1]"""
MOST_DRAWN = 50_000
"""Instants: more make a page of tens of megabytes, and no line that could be seen. [1]"""


def kirchhoff_text(comparison: Comparison, notices: Sequence[str]) -> str:
    """Tables of 80 columns, notices, and the line that sums it up."""
    expected = comparison.expected
    stages = {stage: found for stage, found in comparison.figures.items() if stage != "change"}
    header = [f"{stage if key == 'RMSE' else ''}\n{key}" for stage in stages for key in ("RMSE", "max", "mean", "sd")]
    rows = [
        (name, *(f"{value:.2f}" for found in stages.values() for value in vars(found[name]).values()))
        for name in (*comparison.branches, SUM)
    ]
    parts = ", ".join(f"{name} {figure(value, 2)}" for name, value in expected.parts_a.items() if value >= 0.001)
    lines = [
        _printed("Currents [A], positive into the junction", header, rows),
        "",
        f"right sensors would sum to {figure(expected.mean_a)} +- {figure(comparison.usual_sd_a, 2)} A"
        + (f" ({parts})" if parts else ""),
        f"within {BAND:g} sd of that: {_inside(comparison)} of the instants",
    ]
    for stage, residual in comparison.residual.items():
        if residual is not None:
            shares = (f"{name} {_percent(getattr(residual, name))}" for name in ("constant", "gains", "delays", "rest"))
            lines.append(f"of the sum {stage} (mean square): {', '.join(shares)} ({figure(residual.rest_a, 2)} A)")
    last = list(comparison.residual.values())[-1]
    if last is not None and last.alone:
        rows = [
            (
                name,
                f"{100.0 * item['gain_error']:+.1f} %" if abs(item["gain_error"]) <= SLIP else "-",
                _percent(item["gain_share"]),
                *(
                    (f"{round(1e3 * item['delay_s']):+d} ms", _percent(item["delay_share"]))
                    if abs(item["delay_s"]) < MAX_DELAY_S
                    else ("-", "-")
                ),
            )
            for name, item in last.alone.items()
        ]
        header = ["gain error", "explains", "or a delay", "explains"]
        lines += ["", _printed("What one branch alone could explain of how the sum varies", header, rows), ""]
        if any(abs(item["gain_error"]) > SLIP and item["gain_share"] > 0.5 for item in last.alone.values()):
            lines.append("run 'calibrator doctor': a sign or a unit looks wrong")
    total = f"RMSE of the sum: {(before_a := stages['before'][SUM].rmse_a):.2f} A before"
    if "after" in stages:
        after_a = stages["after"][SUM].rmse_a
        ratio = f", {figure(before_a / after_a, 2)} times less" if 0.0 < after_a < before_a else ""
        total += f", {after_a:.2f} A after{ratio}"
    return "\n".join([*lines, *notices, f"{total} ({comparison.full_scale_a:g} A full scale)"])


def kirchhoff_json(comparison: Comparison, notices: Sequence[str]) -> str:
    """Everything but the samples, and the notices."""
    return dumps(comparison.as_json() | {"notices": list(notices)})


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _inside(comparison: Comparison) -> str:
    return ", ".join(f"{stage} {_percent(share)}" for stage, share in comparison.in_band.items())


def _printed(title: str, header: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as text; a name that has no room is broken, and no figure is."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("", overflow="fold")
    for name in header:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = Console(color_system=None)  # lines are broken later, and codes of colours would count
    with console.capture() as capture:
        console.print(table)
    return "\n".join([title, *(line.rstrip() for line in capture.get().splitlines())])


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
    panels: list[tuple[str, dict[str, tuple[Array, str]]]] = []
    sums_a = comparison.sums_a
    for stage, currents_a in comparison.currents_a.items():
        rmse_a = comparison.figures[stage][SUM].rmse_a
        share = f"{100.0 * rmse_a / comparison.full_scale_a:.2f} % of full scale"
        shown = np.where(comparison.valid[:, None], currents_a, np.nan)
        lines = {name: (shown[:, k], _COLOURS[k % len(_COLOURS)]) for k, name in enumerate(comparison.branches)}
        lines |= {"sum of all": (sums_a[stage], "black")}
        panels.append((f"{stage}: RMSE of the sum {rmse_a:.2f} A = {share}", lines))
    sums = {f"sum {stage}": (sum_a, "black" if stage == "before" else _COLOURS[1]) for stage, sum_a in sums_a.items()}
    panels.append((f"the sum, and the band of right sensors; within it: {_inside(comparison)}", sums))
    sd_a = np.where(comparison.valid, comparison.expected.sd_a, np.nan)
    band = (comparison.expected.mean_a - BAND * sd_a, comparison.expected.mean_a + BAND * sd_a)
    time_s, every = comparison.time_s, -(-len(sd_a) // MOST_DRAWN)
    if every > 1:
        title += f" (1 instant of {every})"
        time_s, band = time_s[::every], (band[0][::every], band[1][::every])
        panels = [(head, {name: (a[::every], colour) for name, (a, colour) in x.items()}) for head, x in panels]
    if path.suffix.lower() == ".html":
        content = _page(panels, time_s, band, title)
    else:
        content = _picture(panels, time_s, band, title, path.suffix.lower()[1:])
    _write(path, content, "picture")


_Panels = Sequence[tuple[str, dict[str, tuple[Array, str]]]]
"""Diagrams from top to bottom: title, and values and colour of each line by name; the band belongs to the last one."""
_Band = tuple[Array, Array]


def _picture(panels: _Panels, time_s: Array, band: _Band, title: str, form: str) -> bytes:
    import matplotlib as mpl  # noqa: PLC0415 (half a second, of no use for a page)
    from matplotlib.figure import Figure  # noqa: PLC0415

    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True}):
        drawing = Figure(figsize=(8.0, 1.0 + 2.5 * len(panels)), layout="constrained")
        all_axes = drawing.subplots(len(panels), sharex=True)
        all_axes[-1].fill_between(time_s, *band, color=_BAND_COLOUR, linewidth=0, label="expected")
        all_axes[-1].set_xlabel("time [s]")
        for axes, (heading, lines) in zip(all_axes, panels, strict=True):
            for name, (value, colour) in lines.items():
                axes.plot(time_s, value, color=colour, linewidth=0.9, label=name)
            axes.set_title(heading, loc="left", fontsize=9)
            axes.set_ylabel("current [A]")
            axes.margins(x=0.0)
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        drawing.suptitle(title, fontsize=10)
        content = io.BytesIO()
        drawing.savefig(content, format=form, dpi=150)
    return content.getvalue()


def _page(panels: _Panels, time_s: Array, band: _Band, title: str) -> bytes:
    from plotly.subplots import make_subplots  # noqa: PLC0415 (of no use for a picture)

    headings, rows = [heading for heading, _ in panels], len(panels)
    drawing = make_subplots(rows=rows, shared_xaxes=True, vertical_spacing=0.07, subplot_titles=headings)
    edge = {"x": time_s, "line_width": 0, "hoverinfo": "skip", "row": rows, "col": 1}
    drawing.add_scatter(y=band[0], showlegend=False, **edge)
    drawing.add_scatter(y=band[1], fill="tonexty", fillcolor=_BAND_COLOUR, name="expected", **edge)
    seen = set[str]()
    for row, (_, lines) in enumerate(panels, start=1):
        for name, (value, colour) in lines.items():
            style = {"line": {"color": colour, "width": 1.2}, "legendgroup": name, "showlegend": name not in seen}
            drawing.add_scatter(x=time_s, y=value, name=name, **style, row=row, col=1)
            seen.add(name)
    drawing.update_yaxes(title_text="current [A]")
    drawing.update_xaxes(title_text="time [s]", row=rows, col=1)
    drawing.update_layout(title_text=title, template="plotly_white", hovermode="x unified", height=120 + 280 * rows)
    drawing.update_annotations(x=0.0, xanchor="left", font_size=13)
    page = drawing.to_html(include_plotlyjs=True, config={"displaylogo": False, "responsive": True})
    return str(page).replace("<head>", f"<head><title>{html.escape(title)}</title>", 1).encode()


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
    import pandas as pd  # noqa: PLC0415 (half a second, of no use without a table)

    columns: dict[str, Array] = {}
    for stage, currents_a in comparison.currents_a.items():
        end = "_a" if stage == "before" else "_corrected_a"
        columns |= {f"{name}{end}": currents_a[:, k] for k, name in enumerate(comparison.branches)}
        columns[f"{SUM}{end}"] = comparison.sums_a[stage]
    columns["expected_sd_a"] = comparison.expected.sd_a
    frame = pd.DataFrame({name: np.where(comparison.valid, value, np.nan) for name, value in columns.items()})
    frame.insert(0, "time_s", comparison.time_s)
    frame = frame.round(6)
    is_parquet = path.suffix.lower() == ".parquet"
    _write(
        path, bytes(frame.to_parquet(None, index=False) if is_parquet else frame.to_csv(index=False).encode()), "table"
    )


def _write(path: Path, content: bytes, what: str) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        raise DriveError(f"{path}: cannot write the {what}: {error.strerror}; choose another folder") from None
