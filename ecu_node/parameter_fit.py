"""Whether parameters may be applied here: made for this vehicle, layout and DBC, decided on, and within the limits."""

from ecu_node.database import VehicleDatabase
from ecu_node.errors import UnfitError, shown_name
from ecu_node.layout import Layout
from ecu_node.parameters import BranchParameters, VehicleParameters, Verdict
from ecu_node.status import Reason

__all__ = ["check_fit"]

_LARGEST_DELAY_S = 5.0
"""Branches of one vehicle do not lag each other by more. [s]"""
_UNDECIDED: tuple[Verdict, ...] = ("cannot tell", "not enough data")
"""Verdicts with which nothing was found that could be applied."""


def check_fit(parameters: VehicleParameters, database: VehicleDatabase, vehicle: str | None) -> None:
    """Check that parameters were made for this vehicle, layout and DBC, decided on, and within the layout's limits.

    A file whose verdict is "cannot tell" or "not enough data" fits only if it applies no branch. Limits are those of
    what is applied.

    Parameters
    ----------
    parameters : VehicleParameters
        From :func:`~ecu_node.parameters.read_parameters`.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle that the node rides in; None: not checked.

    Raises
    ------
    UnfitError
        With the reason that the node then publishes; the message gives both values.
    """
    _check_belongs(parameters, database, vehicle)
    layout = database.layout
    if not abs(parameters.junction_residual.expected_a) <= layout.offset_limit_a:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"an expected Kirchhoff sum of {parameters.junction_residual.expected_a:+.4g} A is beyond the layout's "
            f"limit of offsets, {layout.offset_limit_a:g} A",
        )
    applied = [name for name, branch in parameters.branches.items() if branch.apply]
    if parameters.verdict in _UNDECIDED and applied:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"verdict {parameters.verdict!r}, yet branch {', '.join(map(shown_name, applied))} has 'apply': true; "
            f"nothing was found to apply, calibrate with more drives",
        )
    for name, branch in parameters.branches.items():
        _check_branch(name, branch, layout)


def _check_belongs(parameters: VehicleParameters, database: VehicleDatabase, vehicle: str | None) -> None:
    """Check that parameters were made for this vehicle, layout and DBC."""
    layout = database.layout
    if vehicle is not None and parameters.vehicle != vehicle:
        raise UnfitError(
            Reason.WRONG_VEHICLE, f"parameters are for vehicle {parameters.vehicle!r}, this is {vehicle!r}"
        )
    if parameters.layout.sha256 != layout.digest:
        raise UnfitError(
            Reason.WRONG_LAYOUT,
            f"parameters were made with layout {shown_name(parameters.layout.name)} ({parameters.layout.sha256[:12]}), "
            f"this is {layout.path} ({layout.digest[:12]}); calibrate with this layout; for a file "
            "made by hand print a new 'ecu-node template'",
        )
    if parameters.dbc.sha256 != database.digest:
        raise UnfitError(
            Reason.WRONG_DBC,
            f"parameters were made with DBC {shown_name(parameters.dbc.name)} ({parameters.dbc.sha256[:12]}), "
            f"this is {layout.dbc_path} ({database.digest[:12]}); calibrate with this DBC; for a file "
            "made by hand print a new 'ecu-node template'",
        )


def _check_branch(name: str, branch: BranchParameters, layout: Layout) -> None:
    """Check that the layout has a branch, and that what is applied to it is within the limits."""
    if name not in layout.branch_names:
        raise UnfitError(
            Reason.WRONG_LAYOUT, f"parameters for branch {shown_name(name)!r}, which {layout.path} does not have"
        )
    if abs(branch.delay_s or 0.0) > _LARGEST_DELAY_S:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS, f"branch {name}: delay {branch.delay_s:g} s is beyond {_LARGEST_DELAY_S:g} s"
        )
    if not branch.apply:
        return
    if not abs(branch.drift) <= layout.limits.drift:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"branch {name}: drift {branch.drift:+.4g} is beyond the layout's limit of {layout.limits.drift:g}",
        )
    if not abs(branch.offset_a) <= layout.offset_limit_a:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"branch {name}: offset {branch.offset_a:+.4g} A is beyond the layout's limit of "
            f"{layout.offset_limit_a:g} A",
        )
