"""Text, page and table of a Kirchhoff comparison."""

import html
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import pandas as pd

from calibrator.files.folders import write_files
from calibrator.kirchhoff.sums import BAND, SUM, Comparison
from calibrator.terminal.text import figure, table

__all__ = ["draw_kirchhoff", "kirchhoff_text", "save_table"]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#999999")
"""Okabe and Ito's colours, which colour-blind readers can tell apart; black is kept for the sum that is to be 0 A."""
_BAND_COLOUR = "#D9D9D9"
_SUMS = {"before": "#882255", "after": "black"}
STAGES = {"before": "measured", "after": "corrected"}
"""Names of the stages of a comparison for users."""
SLIP = 0.5
"""A gain error of a larger magnitude is not that of a sensor, but a wrong sign or unit. [1]"""
LEAST_SHARE = 0.005
"""Least share of the sum's variation that is shown: less is written as 0 % and explains nothing. [1]"""
MOST_DRAWN = 50_000
"""Most instants of a picture: more make a page of tens of megabytes, and show nothing more. [1]"""


def kirchhoff_text(comparison: Comparison, notices: Sequence[str]) -> str:
    """Return the figures as text: tables, the notices, and a last line with the root mean square error of the sum."""
    stages = {stage: found for stage, found in comparison.figures.items() if stage != "change"}
    rows = [
        [name, *(f"{value:z.2f}" for value in row)] for name, *row in pd.concat(stages.values(), axis=1).itertuples()
    ]
    header = ["", *(word for stage in stages for word in (STAGES[stage], "", "", ""))]
    parts = ", ".join(f"{name} {figure(value, 2)}" for name, value in comparison.parts_a.items() if value >= 0.001)
    expected = figure(round(comparison.expected_a, 2))
    lines = [
        "Currents [A], positive into the junction",
        table(header, [["", *["RMSE", "max", "mean", "sd"] * len(stages)], *rows]),
        "",
        f"right sensors would sum to {expected} +- {figure(comparison.usual_sd_a, 2)} A"
        + (f" ({parts})" if parts else ""),
        f"within {BAND:g} sd of that: {_inside(comparison)} of the instants",
    ]
    for stage, residual in comparison.residual.items():
        if residual is not None:
            shares = ", ".join(f"{name} {_percent(residual[name])}" for name in ("constant", "gains", "delays", "rest"))
            lines.append(f"of the sum {STAGES[stage]} (mean square): {shares} ({figure(residual['rest_a'], 2)} A)")
    alone = (list(comparison.residual.values())[-1] or {}).get("alone", {})
    if any(own["gain_share"] > LEAST_SHARE for own in alone.values()):
        errors = {name: 100.0 * own["gain_error"] for name, own in alone.items()}
        rows = [
            [name, f"{error:+.1f} %" if abs(error) <= 100.0 * SLIP else "-", _percent(alone[name]["gain_share"])]
            for name, error in errors.items()
        ]
        title = "What the gain of one branch alone could explain of how the sum varies"
        lines += ["", title, table(["", "gain error", "explains"], rows), ""]
    before_a, *corrected_a = (found.loc[SUM, "rmse_a"] for found in stages.values())
    about = "" if expected == "0" else f" about the {expected} A expected"
    total = f"RMSE of the sum{about}: {before_a:.2f} A measured"
    for after_a in corrected_a:
        ratio = f", {figure(before_a / after_a, 2)} times less" if 0.0 < after_a < before_a else ""
        total += f", {after_a:.2f} A corrected{ratio}"
    return "\n".join([*lines, *notices, f"{total} ({comparison.full_scale_a:g} A full scale)"])


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _inside(comparison: Comparison) -> str:
    return ", ".join(f"{STAGES[stage]} {_percent(share)}" for stage, share in comparison.in_band.items())


def draw_kirchhoff(comparison: Comparison, path: Path, *, title: str) -> None:
    """Draw all branch currents and their sum over time, and the sum with its band.

    Parameters
    ----------
    comparison : Comparison
        Currents to draw: a panel as measured and, where there are corrected currents, one as corrected.
    path : Path
        HTML page to write, which needs no other file.
    title : str
        Text above the panels.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    from plotly.subplots import make_subplots  # noqa: PLC0415 (slow, and of no use without a picture)

    every = -(-len(comparison.valid) // MOST_DRAWN)
    title += f" (1 instant of {every})" if every > 1 else ""
    stages = {stage: frame[::every] for stage, frame in comparison.stages.items()}
    about, headings = f" about {figure(comparison.expected_a)} A" if comparison.expected_a else "", list[str]()
    for stage in stages:
        rmse_a = comparison.figures[stage].loc[SUM, "rmse_a"]
        share = f"{100.0 * rmse_a / comparison.full_scale_a:.2f} % of full scale"
        headings.append(f"{STAGES[stage]}: RMSE of the sum{about} {rmse_a:.2f} A = {share}")
    headings.append(f"sum, and band of right sensors (in it: {_inside(comparison)})")
    rows, named = len(headings), set[str]()
    drawing = make_subplots(rows, shared_xaxes=True, vertical_spacing=0.07, subplot_titles=headings)

    def line(name: str, course_a: pd.Series, colour: str, row: int) -> None:
        style = {"line": {"color": colour, "width": 1.2}, "legendgroup": name, "showlegend": name not in named}
        named.add(name)
        drawing.add_scatter(x=course_a.index, y=course_a, name=name, **style, row=row, col=1)

    sd_a = pd.Series(comparison.expected_sd_a, comparison.stages["before"].index)[comparison.valid][::every]
    edge = {"x": sd_a.index, "line_width": 0, "hoverinfo": "skip", "row": rows, "col": 1}
    band = {"fill": "tonexty", "fillcolor": _BAND_COLOUR, "name": "expected"}
    drawing.add_scatter(y=comparison.expected_a - BAND * sd_a, showlegend=False, **edge)
    drawing.add_scatter(y=comparison.expected_a + BAND * sd_a, **band, **edge)
    for row, (stage, frame) in enumerate(stages.items(), start=1):
        for name, colour in zip(comparison.branches, cycle(_COLOURS)):
            line(name, frame[name], colour, row)
        for panel in (row, rows):
            line(f"sum {STAGES[stage]}", frame[SUM], _SUMS[stage], panel)
    drawing.update_yaxes(title_text="current [A]")
    drawing.update_xaxes(title_text="time [s]", row=rows, col=1)
    heading, height = {"text": title.replace(": ", ":<br>", 1), "font_size": 15, "yref": "container"}, 220 + 280 * rows
    # The legend stands at the top, below the title, where it is seen without scrolling.
    heading |= {"y": 1.0 - 15 / height, "yanchor": "top"}
    legend = {"orientation": "h", "yref": "container", "y": 1.0 - 70 / height, "yanchor": "top"}
    drawing.update_layout(title=heading, template="plotly_white", hovermode="x unified", height=height)
    drawing.update_layout(legend=legend, margin={"l": 60, "r": 15, "t": 145})
    drawing.update_annotations(x=0.0, xanchor="left", font_size=12)
    page = drawing.to_html(include_plotlyjs=True, config={"displaylogo": False, "responsive": True})
    head = f'<head><title>{html.escape(title)}</title><meta name="viewport" content="width=device-width">'
    write_files({path: str(page).replace("<head>", head, 1).encode()})


def save_table(comparison: Comparison, path: Path) -> None:
    """Write the currents for a spreadsheet.

    Parameters
    ----------
    comparison : Comparison
        Currents to write.
    path : Path
        File to write, .csv or .parquet: time_s, a column per branch and the sum [A], the same with ``_corrected`` where
        something is corrected, and the expected standard deviation of the sum [A]; empty where not valid.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    ends = {"before": "_a", "after": "_corrected_a"}
    frame = pd.concat([each.add_suffix(ends[stage]) for stage, each in comparison.stages.items()], axis=1)
    frame["expected_sd_a"] = comparison.expected_sd_a
    frame[~comparison.valid] = float("nan")
    frame = frame.reset_index().round(6)
    is_csv = path.suffix.lower() == ".csv"
    write_files({path: frame.to_csv(index=False).encode() if is_csv else frame.to_parquet(None, index=False)})
