"""The words of the monitor: every state and reason, the plain block, JSON."""

import json
from dataclasses import replace

import pytest

from ecu_node.monitor_text import COLUMNS, REASONS, STATES, as_json, node_line, notes, plain_block, rows
from ecu_node.monitor_view import BranchView, FrameFaults, NodeView, Sums, View
from ecu_node.status import Quality, Reason, State

NODE = NodeView(
    state=State.CORRECTING,
    reason=Reason.NONE,
    parameter_set=7,
    sums=Sums(measured_a=12.0, corrected_a=-0.1),
    age_s=0.04,
    is_silent=False,
    faults=FrameFaults(),
)
BRANCH = BranchView(
    name="battery",
    is_seen=True,
    measured_a=100.0,
    corrected_a=95.5,
    correction_a=-4.5,
    quality=Quality.PASSED_THROUGH,
    rate_hz=50.0,
    corrected_rate_hz=49.5,
    age_s=0.0123,
    is_stale=False,
    corrected_is_stale=False,
    faults=FrameFaults(),
    corrected_faults=FrameFaults(),
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
    faults=FrameFaults(),
    corrected_faults=FrameFaults(),
)


def a_view(*branches: BranchView, node: NodeView | None = NODE, **changed: bool) -> View:
    fields = {"has_status": True, "publishes_corrected": True} | changed
    return View(branches=branches, sums=Sums(measured_a=11.5, corrected_a=-0.25), node=node, **fields)


def with_fields(what: BranchView | NodeView, **fields: object) -> dict[str, object]:
    return {name: getattr(what, name) for name in what.__dataclass_fields__} | fields


def branch(**fields: object) -> BranchView:
    return BranchView(**with_fields(BRANCH, **fields))  # type: ignore[arg-type]


def node(**fields: object) -> NodeView:
    return NodeView(**with_fields(NODE, **fields))  # type: ignore[arg-type]


def test_the_plain_block_is_a_table_in_lines() -> None:
    assert plain_block(a_view(BRANCH, MISSING), "socketcan can0").splitlines() == [
        "socketcan can0: node: correcting; parameter set 7; status 0.0 s ago",
        "branch      measured [A]  corrected [A]  correction [A]  quality         rate [1/s]  answers [1/s]  age [s]  "
        "faults",
        "battery          +100.00         +95.50           -4.50  passed through        50.0           49.5     0.01",
        "motor_rear             -              -               -  -                        -              -        -  "
        "not fitted?",
        "sum               +11.50          -0.25          -11.75",
        "node's sum        +12.00          -0.10          -12.10",
    ]


@pytest.mark.parametrize("state", State)
def test_every_state_has_words(state: State) -> None:
    assert STATES[state] in node_line(a_view(BRANCH, node=node(state=state)))


@pytest.mark.parametrize("reason", Reason)
def test_every_reason_has_words(reason: Reason) -> None:
    line = node_line(a_view(BRANCH, node=node(state=State.PASSING_THROUGH, reason=reason)))
    assert (f", because {REASONS[reason]}; " in line) == (reason is not Reason.NONE)


@pytest.mark.parametrize(
    ("view", "line"),
    [
        (a_view(BRANCH, node=None), "no node on this bus"),
        (a_view(BRANCH, node=None, has_status=False), "the layout has no status message: nothing is known of a node"),
        (
            a_view(BRANCH, node=node(is_silent=True, age_s=3.21)),
            "no node on this bus any more: its last status came 3.2 s ago",
        ),
        (
            a_view(BRANCH, node=node(state=9, parameter_set=0, faults=FrameFaults(corrupt=2))),
            "node: state 9, which this version does not know; status 0.0 s ago; corrupt 2",
        ),
    ],
)
def test_a_node_that_is_missing_silent_or_newer_is_said(view: View, line: str) -> None:
    assert node_line(view) == line


@pytest.mark.parametrize(
    ("shown", "faults", "is_faulty"),
    [
        (BRANCH, "", False),
        (branch(is_stale=True, measured_a=None), "stale", True),
        (branch(measured_a=None), "not available", True),
        (branch(corrected_is_stale=True), "corrected: stale", True),
        (branch(is_stale=True, corrected_is_stale=True), "stale", True),
        (branch(faults=FrameFaults(corrupt=1, repeated=2, lost=3)), "corrupt 1, repeated 2, lost 3", False),
        (branch(corrected_faults=FrameFaults(lost=3)), "corrected: lost 3", False),
        (MISSING, "not fitted?", False),
    ],
)
def test_faults_are_told_and_those_that_last_stand_out(shown: BranchView, faults: str, is_faulty: bool) -> None:
    row = rows(a_view(shown))[0]
    assert (row.cells[-1], row.is_faulty, row.is_seen) == (faults, is_faulty, shown.is_seen)
    assert len(row.cells) == len(COLUMNS)


def test_a_branch_that_is_not_published_has_no_answers() -> None:
    assert rows(a_view(branch(corrected_a=None, corrected_rate_hz=0.0)))[0].cells[6] == "-"


@pytest.mark.parametrize("state", [State.PASSING_THROUGH, State.SHADOW])
def test_a_corrected_sum_of_the_node_that_nobody_publishes_is_explained(state: State) -> None:
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


def test_json_names_what_are_codes_on_the_bus() -> None:
    document = json.loads(json.dumps(as_json(a_view(BRANCH, MISSING, node=node(reason=77)))))
    assert [item["quality"] for item in document["branches"]] == ["PASSED_THROUGH", None]
    assert (document["node"]["state"], document["node"]["reason"]) == ("CORRECTING", 77)
    assert document["sums"] == {"measured_a": 11.5, "corrected_a": -0.25}
    assert as_json(a_view(BRANCH, node=None))["node"] is None
