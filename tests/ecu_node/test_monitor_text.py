"""The words of the monitor: every state and reason, the table, the notes below it."""

from dataclasses import replace

import pytest

from ecu_node.core.status import Reason, State
from ecu_node.monitor import BranchView, NodeView, Sums, View, view_lines

NO_FAULTS = {"corrupt": 0, "repeated": 0, "lost": 0}
NODE = NodeView(
    state="CORRECTING",
    reason="NONE",
    parameter_set=7,
    sums=Sums(measured_a=12.0, corrected_a=-0.1),
    age_s=0.04,
    is_silent=False,
    faults=NO_FAULTS,
)
BRANCH = BranchView(
    name="battery",
    is_seen=True,
    measured_a=100.0,
    corrected_a=95.5,
    correction_a=-4.5,
    quality="PASSED_THROUGH",
    rate_hz=50.0,
    corrected_rate_hz=49.5,
    age_s=0.0123,
    is_stale=False,
    corrected_is_stale=False,
    faults=NO_FAULTS,
    corrected_faults=NO_FAULTS,
)
MISSING = BranchView(
    name="motor_rear",
    is_seen=False,
    measured_a=None,
    corrected_a=None,
    correction_a=None,
    quality=None,
    rate_hz=0.0,
    corrected_rate_hz=0.0,
    age_s=None,
    is_stale=False,
    corrected_is_stale=False,
    faults=NO_FAULTS,
    corrected_faults=NO_FAULTS,
)


STALE = replace(
    BRANCH,
    name="motor",
    measured_a=-1234.56,
    corrected_a=-1200.0,
    age_s=12.01,
    is_stale=True,
    faults={"corrupt": 12, "repeated": 0, "lost": 3},
)


def a_view(*branches: BranchView, node: NodeView | None = NODE, **changed: bool) -> View:
    fields = {"has_status": True, "publishes_corrected": True} | changed
    return View(branches=branches, sums=Sums(measured_a=11.5, corrected_a=-0.25), node=node, **fields)


def texts(view: View) -> list[str]:
    return [line.text for line in view_lines(view, "socketcan can0")]


def notes(view: View) -> list[str]:
    lines = texts(view)
    return lines[next(k for k, line in enumerate(lines) if line.startswith("node's sum")) + 1 :]


def test_the_view_is_a_table_in_lines() -> None:
    assert texts(a_view(BRANCH, STALE, MISSING)) == [
        "socketcan can0: node: correcting; parameter set 7; status 0.0 s ago",
        "           measured corrected correction                 rate answers   age",
        "branch          [A]       [A]        [A] quality        [1/s]   [1/s]   [s] faults",
        "battery     +100.00    +95.50      -4.50 passed through  50.0    49.5  0.01",
        "motor      -1234.56  -1200.00      -4.50 passed through  50.0    49.5 12.01 stale, corrupt 12, lost 3",
        "motor_rear        -         -          - -                  -       -     - not fitted?",
        "sum          +11.50     -0.25     -11.75",
        "node's sum   +12.00     -0.10     -12.10",
    ]


@pytest.mark.parametrize("state", State)
def test_every_state_has_words(state: State) -> None:
    words = texts(a_view(BRANCH, node=replace(NODE, state=state.name)))[0].removeprefix("socketcan can0: node: ")
    assert state.name.lower().replace("_", " ")[:7] in words
    assert "does not know" not in words


@pytest.mark.parametrize("reason", Reason)
def test_every_reason_has_words(reason: Reason) -> None:
    line = texts(a_view(BRANCH, node=replace(NODE, state="PASSING_THROUGH", reason=reason.name)))[0]
    assert (", because " in line) == (reason is not Reason.NONE)
    assert "does not know" not in line


@pytest.mark.parametrize(
    ("view", "line"),
    [
        (a_view(BRANCH, node=None), "no node on this bus"),
        (a_view(BRANCH, node=None, has_status=False), "the layout has no status message: nothing is known of a node"),
        (
            a_view(BRANCH, node=replace(NODE, is_silent=True, age_s=3.21)),
            "no node on this bus any more: its last status came 3.2 s ago",
        ),
        (
            a_view(BRANCH, node=replace(NODE, state=9, parameter_set=0, faults={**NO_FAULTS, "corrupt": 2})),
            "node: state 9, which this version does not know; status 0.0 s ago; corrupt 2",
        ),
    ],
)
def test_a_node_that_is_missing_silent_or_newer_is_said(view: View, line: str) -> None:
    assert texts(view)[0] == f"socketcan can0: {line}"
    shows_node = view.node is not None and not view.node.is_silent
    assert any(text.startswith("node's sum") for text in texts(view)) == shows_node


@pytest.mark.parametrize(
    ("shown", "faults", "style"),
    [
        (BRANCH, "", ""),
        (replace(BRANCH, is_stale=True, measured_a=None), "stale", "33"),
        (replace(BRANCH, measured_a=None), "not available", "33"),
        (replace(BRANCH, corrected_is_stale=True), "corrected: stale", "33"),
        (replace(BRANCH, is_stale=True, corrected_is_stale=True), "stale", "33"),
        (replace(BRANCH, faults={"corrupt": 1, "repeated": 2, "lost": 3}), "corrupt 1, repeated 2, lost 3", ""),
        (replace(BRANCH, corrected_faults={**NO_FAULTS, "lost": 3}), "corrected: lost 3", ""),
        (MISSING, "not fitted?", "2"),
    ],
)
def test_faults_are_shown_and_those_that_last_stand_out(shown: BranchView, faults: str, style: str) -> None:
    row = view_lines(a_view(shown), "socketcan can0")[3]
    assert row.text.partition("-" if shown is MISSING else "0.01")[2].strip("- ") == faults
    assert row.style == style


def test_a_branch_that_is_not_published_has_no_answers() -> None:
    assert texts(a_view(replace(BRANCH, corrected_a=None, corrected_rate_hz=0.0)))[3].split()[-2:] == ["-", "0.01"]


@pytest.mark.parametrize("state", ["PASSING_THROUGH", "SHADOW"])
def test_a_corrected_sum_of_the_node_that_nobody_publishes_is_explained(state: str) -> None:
    words = "node's sum, corrected: what its parameters would make of it; it publishes what was measured"
    assert notes(a_view(BRANCH, node=replace(NODE, state=state))) == [words]
    passed = replace(NODE, state=state, sums=Sums(measured_a=12.0, corrected_a=12.0))
    assert notes(a_view(BRANCH, node=passed)) == []
    assert notes(a_view(BRANCH)) == []


def test_what_a_bus_lacks_is_noted() -> None:
    assert notes(a_view(BRANCH)) == []
    assert notes(a_view(MISSING)) == ["no frame of any branch: is the bus awake, and its bit rate the right one?"]
    assert notes(a_view(BRANCH, publishes_corrected=False)) == [
        "no corrected messages on this bus: the currents are shown as they are on it"
    ]
