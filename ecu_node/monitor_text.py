"""The words and numbers of ``ecu-node monitor``, as a plain block of text, as JSON, and as cells of a table."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from ecu_node.monitor_view import BranchView, FrameFaults, NodeView, Sums, View
from ecu_node.status import Reason, State

__all__ = ["COLUMNS", "LEFT", "REASONS", "STATES", "Row", "as_json", "node_line", "notes", "plain_block", "rows"]

COLUMNS = (  # "rate" of the measured frames, "answers" of the corrected ones
    "branch",
    "measured [A]",
    "corrected [A]",
    "correction [A]",
    "quality",
    "rate [1/s]",
    "answers [1/s]",
    "age [s]",
    "faults",
)
LEFT = {"branch", "quality", "faults"}
"""Columns of words."""

STATES = {
    State.STARTING: "starting: waiting for the first frames of all branches",
    State.CORRECTING: "correcting",
    State.PASSING_THROUGH: "passing measured values through",
    State.SHADOW: "shadow mode: computing, but passing measured values through",
    State.ASLEEP: "asleep: no branch sends",
}
REASONS = {
    Reason.NONE: "",
    Reason.NO_PARAMETERS: "there is no parameter file",
    Reason.MALFORMED_PARAMETERS: "the parameter file cannot be read",
    Reason.WRONG_VEHICLE: "the parameters are of another vehicle",
    Reason.WRONG_LAYOUT: "the parameters are for another layout",
    Reason.WRONG_DBC: "the parameters are for another DBC",
    Reason.IMPLAUSIBLE_PARAMETERS: "the parameters are beyond the limits of the layout",
    Reason.BRANCH_STALE: "a branch has sent nothing for longer than its timeout",
    Reason.CORRECTION_WORSE: "the corrected Kirchhoff sum is worse than the measured one",
    Reason.BRANCH_STUCK: "a branch never changes while the others do",
    Reason.INPUT_MISSING: "a voltage, or a value of a branch, is missing; not everything is corrected",
    Reason.NOT_SIGNED: "the parameters are not what trusted signers have signed",
    Reason.NOT_VALID_NOW: "the parameters have expired, or do not hold yet",
    Reason.REPLAYED: "the parameters are older than what was accepted before",
    Reason.REVOKED: "the parameters were revoked",
    Reason.ON_TRIAL: "the parameters are on trial",
}


_PASSING = (State.PASSING_THROUGH, State.SHADOW)
"""States in which the status tells a corrected sum that nobody publishes."""


class Row(NamedTuple):
    """One line of the table."""

    cells: tuple[str, ...]
    """As many as :data:`COLUMNS`."""
    is_seen: bool
    """Of a branch; others count as seen."""
    is_faulty: bool
    """Whether the last cell tells of a fault that lasts."""


def node_line(view: View) -> str:
    """What the node does, and why, in one line; or that the bus cannot be listened to."""
    node = view.node
    if not view.is_bus_open:
        return "this computer's interface failed or is down; trying to open it again; what is shown was heard before"
    if not view.has_status:
        return "the layout has no status message: nothing is known of a node"
    if node is None:
        return "no node on this bus"
    if node.is_silent:
        return f"no node on this bus any more: its last status came {node.age_s:.1f} s ago"
    words = _words(STATES, node.state, "state")
    if node.reason:
        words += f", because {_words(REASONS, node.reason, 'reason')}"
    which = f"; parameter set {node.parameter_set}" if node.parameter_set else ""
    faults = _fault_texts(node.faults, "")
    return f"node: {words}{which}; status {node.age_s:.1f} s ago{'; ' if faults else ''}{', '.join(faults)}"


def notes(view: View) -> list[str]:
    """What else a reader should know."""
    if not view.is_any_branch_seen and view.is_bus_open:
        return ["no frame of any branch: is the bus awake, and its bit rate the right one?"]
    told = []
    if not view.publishes_corrected:
        told.append("no corrected messages on this bus: the currents are shown as they are on it")
    node = view.node
    is_passing = node is not None and not node.is_silent and node.state in _PASSING
    if node is not None and is_passing and node.sums.corrected_a != node.sums.measured_a:
        told.append("node's sum, corrected: what its parameters would make of it; it publishes what was measured")
    return told


def rows(view: View) -> list[Row]:
    """The table: a row per branch, then the sums.

    Parameters
    ----------
    view : View
        What is to be shown.

    Returns
    -------
    list of Row
        Cells as text; a number that is not known is "-".
    """
    table = [_branch_row(branch) for branch in view.branches]
    table.append(_sum_row("sum", view.sums))
    if isinstance(view.node, NodeView) and not view.node.is_silent:
        table.append(_sum_row("node's sum", view.node.sums))
    return table


def plain_block(view: View, where: str, more: Sequence[str] = ()) -> str:
    """Everything as plain text.

    Parameters
    ----------
    view : View
        What is to be shown.
    where : str
        Name of the bus.
    more : sequence of str
        Further lines.

    Returns
    -------
    str
        Several lines, the last one without a line end.
    """
    table = [COLUMNS, *(row.cells for row in rows(view))]
    widths = [max(len(cells[column]) for cells in table) for column in range(len(COLUMNS))]
    lines = [f"{where}: {node_line(view)}"]
    for cells in table:
        padded = [
            cell.ljust(width) if name in LEFT else cell.rjust(width)
            for name, cell, width in zip(COLUMNS, cells, widths, strict=True)
        ]
        lines.append("  ".join(padded).rstrip())
    return "\n".join([*lines, *notes(view), *more])


def as_json(view: View) -> dict[str, Any]:
    """The view as a document: fields as in :class:`~ecu_node.monitor_view.View`, codes of the node by name."""
    document = asdict(view)
    for branch, seen in zip(document["branches"], view.branches, strict=True):
        branch["quality"] = seen.quality.name if seen.quality is not None else None
    if view.node is not None:
        document["node"]["state"] = _name(State, view.node.state)
        document["node"]["reason"] = _name(Reason, view.node.reason)
    return document


def _branch_row(branch: BranchView) -> Row:
    if not branch.is_seen:
        told = ["not fitted?", *_fault_texts(branch.faults, "")]
        return Row((branch.name, *["-"] * (len(COLUMNS) - 2), ", ".join(told)), is_seen=False, is_faulty=False)
    lasting = [text for text, is_so in _lasting_faults(branch) if is_so]
    told = [*lasting, *_fault_texts(branch.faults, ""), *_fault_texts(branch.corrected_faults, "corrected: ")]
    return Row(
        (
            branch.name,
            _current(branch.measured_a),
            _current(branch.corrected_a),
            _current(branch.correction_a),
            branch.quality.name.lower().replace("_", " ") if branch.quality is not None else "-",
            f"{branch.rate_hz:.1f}",
            f"{branch.corrected_rate_hz:.1f}" if branch.corrected_rate_hz or branch.corrected_a is not None else "-",
            f"{branch.age_s:.2f}",
            ", ".join(told),
        ),
        is_seen=True,
        is_faulty=bool(lasting),
    )


def _lasting_faults(branch: BranchView) -> Sequence[tuple[str, bool]]:
    return (
        ("stale", branch.is_stale),
        ("not available", branch.measured_a is None and not branch.is_stale),
        ("corrected: stale", branch.corrected_is_stale and not branch.is_stale),
    )


def _fault_texts(faults: FrameFaults, prefix: str) -> list[str]:
    return [f"{prefix}{name} {count}" for name, count in asdict(faults).items() if count]


def _sum_row(name: str, sums: Sums) -> Row:
    known = sums.measured_a is not None and sums.corrected_a is not None
    correction = sums.corrected_a - sums.measured_a if known else None  # type: ignore[operator]
    cells = (name, _current(sums.measured_a), _current(sums.corrected_a), _current(correction))
    return Row((*cells, *[""] * (len(COLUMNS) - len(cells))), is_seen=True, is_faulty=False)


def _current(value_a: float | None) -> str:
    return f"{value_a:+.2f}" if value_a is not None else "-"


def _words(table: dict[Any, str], code: int | None, what: str) -> str:
    return table.get(code, f"{what} {code}, which this version does not know")


def _name(names: type[State | Reason], code: int | None) -> str | int | None:
    return names(code).name if code in set(names) else code
