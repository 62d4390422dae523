"""What ``ecu-node monitor`` shows of one instant. Currents are positive into the junction."""

from dataclasses import dataclass

from ecu_node.status import Quality

__all__ = ["BranchView", "FrameFaults", "NodeView", "Sums", "View"]


@dataclass(frozen=True, kw_only=True)
class FrameFaults:
    """Frames of one message that failed their end-to-end check since the monitor was started.

    Attributes
    ----------
    corrupt : int
        Wrong CRC, impossible counter, or too short for their header.
    repeated : int
        Counter of the one before.
    lost : int
        Times that the counter showed lost frames, few or many.
    """

    corrupt: int = 0
    repeated: int = 0
    lost: int = 0


@dataclass(frozen=True, kw_only=True)
class BranchView:
    """One branch.

    Attributes
    ----------
    name : str
        As in the layout.
    is_seen : bool
        Whether an intact frame of it ever came; a vehicle may lack a branch of its layout.
    measured_a, corrected_a : float or None
        In the last intact frames [A]; None where there is none, or it is no value. A measured frame that came since
        the last corrected one is not shown before it is answered, or the other one is stale.
    correction_a : float or None
        Corrected less measured current, both as shown. [A]
    quality : Quality or None
        Of the corrected current; None where it is not told.
    rate_hz, corrected_rate_hz : float
        Frames of the measured and of the corrected message. [1/s]
    age_s : float or None
        Of the last intact measured frame. [s]
    is_stale, corrected_is_stale : bool
        Whether intact frames came, but none for longer than the branch's timeout.
    faults, corrected_faults : FrameFaults
        Of the measured and of the corrected message.
    """

    name: str
    is_seen: bool
    measured_a: float | None
    corrected_a: float | None
    correction_a: float | None
    quality: Quality | None
    rate_hz: float
    corrected_rate_hz: float
    age_s: float | None
    is_stale: bool
    corrected_is_stale: bool
    faults: FrameFaults
    corrected_faults: FrameFaults


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Kirchhoff sum of all branches, measured and corrected, in one instant [A]; None where it is not known."""

    measured_a: float | None = None
    corrected_a: float | None = None


@dataclass(frozen=True, kw_only=True)
class NodeView:
    """What the node says of itself in its last intact status message.

    Attributes
    ----------
    state, reason : int or None
        See :class:`~ecu_node.status.State` and :class:`~ecu_node.status.Reason`; None if the message was too short.
    parameter_set : int or None
        None if the layout leaves it out.
    sums : Sums
        As the node publishes them.
    age_s : float
        Of the message. [s]
    is_silent : bool
        Whether the message is so old that the node must be gone.
    faults : FrameFaults
        Of the status message.
    """

    state: int | None
    reason: int | None
    parameter_set: int | None
    sums: Sums
    age_s: float
    is_silent: bool
    faults: FrameFaults


@dataclass(frozen=True, kw_only=True)
class View:
    """Everything that is shown of one instant.

    Attributes
    ----------
    branches : tuple of BranchView
        All of the layout, in its order.
    sums : Sums
        Worked out from the branches' frames.
    node : NodeView or None
        None if no status message ever came.
    has_status : bool
        Whether the layout has a status message at all.
    publishes_corrected : bool
        Whether a corrected message ever came; there is none on the buses of a gateway.
    is_bus_open : bool
        Whether the bus can be listened to; if not, all this was heard before.
    """

    branches: tuple[BranchView, ...]
    sums: Sums
    node: NodeView | None
    has_status: bool
    publishes_corrected: bool
    is_bus_open: bool = True

    @property
    def is_any_branch_seen(self) -> bool:
        """Whether anything of the junction was seen."""
        return any(branch.is_seen for branch in self.branches)
