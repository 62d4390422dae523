"""The live picture in terminals of several widths: no number is cut, and what has no room is told below."""

from dataclasses import replace

import pytest

from ecu_node.monitor_table import picture
from ecu_node.monitor_view import FrameFaults, View
from ecu_node.status import Quality, Reason, State
from tests.ecu_node.test_monitor_text import BRANCH, MISSING, NODE, a_view

STALE = replace(
    BRANCH,
    name="motor",
    measured_a=-1234.56,
    corrected_a=-1200.0,
    is_stale=True,
    faults=FrameFaults(corrupt=12, lost=3),
)
VIEW = a_view(BRANCH, STALE, MISSING)


def drawn(width: int, height: int = 24, view: View = VIEW) -> list[str]:
    lines = picture(view, "socketcan can0", ["error frames of the bus: 3"], width=width, height=height)
    assert len(lines) <= height
    assert all(len(line.text) <= width for line in lines)
    return [line.text for line in lines]


def test_a_wide_terminal_shows_one_table() -> None:
    assert drawn(140) == [
        "socketcan can0: node: correcting; parameter set 7; status 0.0 s ago",
        "",
        "            measured  corrected  correction                   rate  answers   age",
        "branch           [A]        [A]         [A]  quality         [1/s]    [1/s]   [s]  faults",
        108 * "─",
        "battery      +100.00     +95.50       -4.50  passed through   50.0     49.5  0.01",
        "motor       -1234.56   -1200.00       -4.50  passed through   50.0     49.5  0.01  stale, corrupt 12, lost 3",
        "motor_rear         -          -           -  -                   -        -     -  not fitted?",
        "",
        "sum           +11.50      -0.25      -11.75",
        "node's sum    +12.00      -0.10      -12.10",
        "error frames of the bus: 3",
    ]


def test_in_80_columns_faults_are_told_below_the_table() -> None:
    assert drawn(80)[2:] == [
        "           measured corrected correction                 rate answers  age",
        "branch          [A]       [A]        [A] quality        [1/s]   [1/s]  [s]",
        74 * "─",
        "battery     +100.00    +95.50      -4.50 passed through  50.0    49.5 0.01",
        "motor      -1234.56  -1200.00      -4.50 passed through  50.0    49.5 0.01",
        "motor_rear        -         -          - -                  -       -    -",
        "",
        "sum          +11.50     -0.25     -11.75",
        "node's sum   +12.00     -0.10     -12.10",
        "motor: stale, corrupt 12, lost 3",
        "motor_rear: not fitted?",
        "error frames of the bus: 3",
    ]


def test_in_60_columns_currents_and_quality_are_left() -> None:
    assert drawn(60) == [
        "socketcan can0: node: correcting; parameter set 7; status",
        "  0.0 s ago",
        "",
        "            measured  corrected  correction",
        "branch           [A]        [A]         [A]  quality",
        59 * "─",
        "battery      +100.00     +95.50       -4.50  passed through",
        "motor       -1234.56   -1200.00       -4.50  passed through",
        "motor_rear         -          -           -  -",
        "",
        "sum           +11.50      -0.25      -11.75",
        "node's sum    +12.00      -0.10      -12.10",
        "motor: stale, corrupt 12, lost 3",
        "motor_rear: not fitted?",
        "error frames of the bus: 3",
        "a wider terminal also shows: rate, answers, age",
    ]


def test_in_36_columns_the_quality_is_told_below_too() -> None:
    lines = drawn(36)
    assert "motor       -1234.56   -1200.00" in lines
    assert lines[-7:-3] == [
        "battery: passed through",
        "motor: passed through, stale,",
        "  corrupt 12, lost 3",
        "motor_rear: not fitted?",
    ]


@pytest.mark.parametrize("width", range(34, 160))
def test_every_width_shows_every_current_quality_and_fault(width: int) -> None:
    text = " ".join(" ".join(drawn(width, height=40)).split())
    for words in (
        "+100.00",
        "-1234.56",
        "-0.25",
        "-0.10",
        "passed through",
        "stale, corrupt 12, lost 3",
        "not fitted?",
    ):
        assert words in text


def test_in_a_terminal_too_narrow_for_the_currents_lines_are_cut() -> None:
    lines = drawn(16, height=60)
    assert lines[lines.index(16 * "─") + 1] == "battery     +100"


def test_a_line_is_marked_by_what_it_tells() -> None:
    styles = {
        line.text.split(":")[0].split()[0]: line.style for line in picture(VIEW, "can0", width=80, height=24)[5:8]
    }
    assert styles == {"battery": "", "motor": "yellow", "motor_rear": "dim"}


def test_a_low_terminal_shows_the_first_lines_and_says_how_many_are_missing() -> None:
    assert drawn(80, height=12)[-1] == "error frames of the bus: 3"  # without the empty lines all have room
    low = drawn(80, height=6)
    assert low[-2:] == [drawn(80)[5], "7 more lines do not fit"]


def test_that_lines_are_missing_is_said_whole_on_a_small_terminal() -> None:
    assert drawn(30, height=8)[-1].endswith(" more lines do not fit")


def test_the_longest_reason_is_wrapped() -> None:
    node = replace(NODE, state=State.PASSING_THROUGH, reason=Reason.INPUT_MISSING)
    lines = drawn(60, view=a_view(replace(BRANCH, quality=Quality.INVALID), node=node))
    assert lines[0].startswith("socketcan can0: node: passing measured values through,")
    assert any(line.endswith("status 0.0 s ago") for line in lines[:5])
