"""``ecu-node template``: a parameter file to be filled in by hand, from what was measured on a bench."""

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ecu_node import __version__
from ecu_node.errors import LayoutError
from ecu_node.standard_output import write_output

if TYPE_CHECKING:
    from ecu_node.database import VehicleDatabase

__all__ = ["add_template_command", "template_text"]

_LONGEST_VEHICLE = 64
"""Characters, as in the parameter file."""


def add_template_command(commands: "argparse._SubParsersAction[Any]") -> None:
    """Add the command to a parser.

    Parameters
    ----------
    commands : argparse's subparsers
        Of ``ecu-node``; the command is left in ``command`` as a callable that takes the options.
    """
    template = commands.add_parser(
        "template",
        help="print a parameter file to be filled in by hand",
        description="Prints a parameter file that fits the layout and corrects nothing yet. Where the fault of a "
        "sensor was measured, write it there: drift [1], offset_a [A, positive into the junction], and "
        '"apply": true; measured = (1 + drift) * true + offset. A load that no branch measures stands in '
        "expected_a [A], as [unmeasured_load] of the layout says. Take out branches that this vehicle does not have: "
        "the node would wait for their frames. All else can stay as it is.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong use, 70 internal error, 130 interrupted.",
    )
    template.add_argument(
        "--layout", type=Path, required=True, metavar="FILE", help="layout (TOML), which names the DBC"
    )
    template.add_argument("--vehicle", required=True, type=_vehicle, metavar="ID", help="identity of the vehicle")
    template.set_defaults(command=_template)


def _vehicle(text: str) -> str:
    if not text.strip() or len(text) > _LONGEST_VEHICLE or not text.isprintable():
        raise argparse.ArgumentTypeError(
            f"the identity of the vehicle is expected, of at most {_LONGEST_VEHICLE} characters that can be printed"
        )
    return text


def _template(options: argparse.Namespace) -> int:
    from ecu_node.database import node_database  # noqa: PLC0415  # takes time to import

    write_output(template_text(node_database(options.layout), options.vehicle, datetime.now(UTC)))
    return 0


def template_text(database: "VehicleDatabase", vehicle: str, now: datetime) -> str:
    """Make a parameter file that corrects nothing yet.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    vehicle : str
        Its identity.
    now : datetime
        Time of day.

    Returns
    -------
    str
        JSON without what can be left out. The sum that right sensors show is the layout's unmeasured load: it takes
        current out of the junction, so what the branches measure sums to as much above 0 A. The verdict is that of a
        file that corrects, as it is to be once it is filled in.
    """
    layout = database.layout
    load = layout.unmeasured_load
    if load is not None and load.mean_a > layout.offset_limit_a:
        raise LayoutError(
            f"{layout.path}: [unmeasured_load] mean_a = {load.mean_a:g} is beyond the layout's limit of "
            f"{layout.offset_limit_a:g} A ([limits] offset_a), so that no parameters would fit; correct one of them"
        )
    document = {
        "schema_version": 1,
        "vehicle": vehicle,
        "number": 1,
        "layout": {"name": layout.path.name, "sha256": layout.digest},
        "dbc": {"name": layout.dbc_path.name, "sha256": database.digest},
        "verdict": "corrected",
        "branches": {name: {"drift": 0.0, "offset_a": 0.0, "apply": False} for name in layout.branch_names},
        "hardware_fault": {"suspected": False},
        "junction_residual": {
            "measured_a": 0.0,
            "corrected_a": 0.0,
            "expected_a": load.mean_a if load is not None else 0.0,
        },
        "provenance": {
            "tool": f"ecu-node template {__version__}",
            "method": "by hand",
            "created": now.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "fleet": "none",
            "fleet_size": 1,
            "drives": [],
            "duration_s": 0.0,
        },
    }
    return json.dumps(document, indent=2)
