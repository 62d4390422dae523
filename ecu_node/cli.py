"""Command line of the node, ``ecu-node``: run, monitor, check, template, faults, and the commands of updates.

Results go to standard output, events to standard error. Exit code 0: done, 1: failed, 2: wrong use,
70: a fault of the program itself, 130: interrupted by Ctrl-C before the node was at work (at work, Ctrl-C and SIGTERM
end it with 0). Errors are one line; ``--debug``, anywhere, shows the traceback as well.
"""

import argparse
import json
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from ecu_node import __version__
from ecu_node.errors import printable
from ecu_node.program import CommandParser, load_python_can, run_program, write_output, write_result
from ecu_node.update.command import add_update_commands

if TYPE_CHECKING:
    from ecu_node.database import VehicleDatabase


_VEHICLE_VARIABLE = "ECU_NODE_VEHICLE"
_AT_WORK = "done (also when ended by a signal at work)"


def run_ecu_node(argv: Sequence[str] | None = None) -> int:
    """Run a command of ``ecu-node``.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process if not given.

    Returns
    -------
    int
        Exit code: 0 done, 1 failed, 70 a fault of the program itself. Wrong use ends in SystemExit(2), Ctrl-C during
        start-up ends the process with 130.
    """
    return run_program("ecu-node", _main, sys.argv[1:] if argv is None else argv)


def _main(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)
    if options.command is _run:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a node outlives the terminal that it was started from
    logging.getLogger("can").addHandler(logging.NullHandler())
    load_python_can()
    return options.command(options) or 0


def _option(read: Callable[[str], Any], is_right: Callable[[Any], Any], refusal: str) -> Callable[[str], Any]:
    """Make a type for argparse: it returns `read(text)` if `is_right` accepts that, else it refuses the text.

    `refusal` is the message, in which ``{}`` stands for the text.
    """

    def value_of(text: str) -> Any:
        with suppress(ValueError):
            value = read(text)
            if is_right(value):
                return value
        found = ascii(text) if text.strip() else "none"
        raise argparse.ArgumentTypeError(refusal.format(found if len(text) <= 64 else f"{len(text)} characters"))

    return value_of


_NAME = _option(str, str.strip, "a name is expected, such as can0, found {}")
_FOLDER = _option(lambda text: Path(text) if text.strip() else None, bool, "a folder is expected, found {}")
_BIT_RATE = _option(int, lambda rate: rate > 0, "{}: expected a number of bit/s, such as 500000")
_SECONDS = _option(float, lambda s: 0.0 < s <= 86400.0, "{}: expected a number of seconds above 0, at most 86400")
_VEHICLE = _option(
    str,
    lambda text: text.strip() and len(text) <= 64 and text.isprintable(),  # as in the parameter file
    "the identity of the vehicle is expected, printable and of at most 64 characters, found {}",
)


def _read_target(text: str) -> Path | tuple[str, int] | None:
    """Return the target of ``--telemetry``: a file, or host and UDP port; None if the text is neither."""
    if "://" not in text:
        return Path(text) if text.strip() else None
    found = urlsplit(text)
    is_udp = found.scheme == "udp" and found.hostname and found.port and text.endswith(f":{found.port}")
    return (found.hostname, found.port) if is_udp else None  # type: ignore[return-value]


_TARGET = _option(_read_target, bool, "a file or udp://HOST:PORT is expected, found {}")


_OPTIONS: dict[str, dict[str, Any]] = {
    "--layout": {"type": Path, "required": True, "metavar": "FILE", "help": "layout (TOML), which names the DBC"},
    "--vehicle": {
        "type": _VEHICLE,
        "metavar": "ID",
        "help": f"this vehicle; parameters of another are refused (default: ${_VEHICLE_VARIABLE}; else not checked)",
    },
    "--interface": {"default": "socketcan", "help": "python-can interface (default: %(default)s)"},
    "--channel": {"required": True, "type": _NAME, "help": "channel of the interface, such as can0 or vcan0"},
    "--fd": {"action": "store_true", "help": "open the bus for CAN FD"},
    "--bitrate": {
        "type": _BIT_RATE,
        "metavar": "BIT_PER_S",
        "help": "bit rate, where the adapter sets it; this and other settings may stand in python-can's can.conf",
    },
    "--data-bitrate": {"type": _BIT_RATE, "metavar": "BIT_PER_S", "help": "the same of the data of CAN FD frames"},
    "--listen-only": {
        "action": "store_true",
        "help": "send nothing; adapters that can do so acknowledge no frame either",
    },
    "--unsigned": {"action": "store_true", "help": "use parameters that nobody signed, as on a test bench"},
    "--gateway": {
        "type": _NAME,
        "metavar": "CHANNEL",
        "help": "be a gateway: the sensors are on --channel, the rest of the vehicle on this; branch frames are passed "
        "on with the corrected current in place, all others as they are",
    },
    "--shadow": {"action": "store_true", "help": "compute and report the corrected sum, but change nothing"},
    "--dry-run": {"action": "store_true", "help": "print what would be opened, read and sent; open nothing"},
    "--telemetry": {
        "type": _TARGET,
        "metavar": "TARGET",
        "help": "a line of JSON per second, added to a file or sent to udp://HOST:PORT",
    },
    "--summary": {
        "type": _FOLDER,
        "metavar": "FOLDER",
        "help": "sum up each drive for the calibrator, in FOLDER/VEHICLE: kilobytes per hour in place of logs",
    },
    "--realtime": {
        "action": "store_true",
        "help": "run as a real-time process: SCHED_FIFO, locked memory, one processor",
    },
    "--once": {"type": _SECONDS, "metavar": "SECONDS", "help": "listen this long, print what was seen, and end"},
    "--json": {"action": "store_true", "help": "print JSON"},
    "--state": {"type": _FOLDER, "required": True, "metavar": "FOLDER", "help": "state of this vehicle"},
    "--params": {"type": Path, "required": True, "metavar": "FILE", "help": "parameter file of this vehicle"},
}
"""Options that commands share; options of a single command are added where the command is."""
_BUS = "--interface --channel --fd --bitrate --data-bitrate --listen-only"


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="ecu-node",
        description="Corrects the high-voltage currents on a CAN bus with the parameters of this vehicle.",
        done=_AT_WORK,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error; may stand anywhere")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, work: Callable[[argparse.Namespace], Any], options: str, **words: Any) -> Any:
        added = commands.add_parser(name, **words)
        for option in options.split():
            added.add_argument(option, **_OPTIONS[option])
        added.set_defaults(command=work, error=added.error, vehicle=os.environ.get(_VEHICLE_VARIABLE) or None)
        return added

    run = command(
        "run",
        _run,
        f"--unsigned --layout --vehicle {_BUS} --gateway --shadow --dry-run --telemetry --summary --realtime",
        help="correct until SIGTERM or SIGINT",
        description="Reads the branch currents from a bus and publishes them corrected, under identifiers of their "
        "own on the same bus, or, with --gateway, in place on another bus. With parameters that do not fit it passes "
        "the measured values through and says so in its status message. Changes of --state are seen within a second. "
        "Example: ecu-node run --unsigned --params result/params/V1.json --layout my_car.toml --interface socketcan "
        "--channel can0",
        done=_AT_WORK,
    )
    source = run.add_mutually_exclusive_group(required=True)
    source.add_argument("--state", type=_FOLDER, metavar="FOLDER", help="state of this vehicle, with signed parameters")
    source.add_argument("--params", type=Path, metavar="FILE", help="parameter file that nobody signed; --unsigned")
    command(
        "monitor",
        _monitor,
        f"--layout {_BUS} --once --json",
        help="show the branches, their sum and the node, live",
        description="Listens to a bus, and never sends: measured and corrected currents, frame rates, faults, the "
        "Kirchhoff sum, and what the node says of itself. A table in a terminal, else a block of text per second; "
        "--json goes with --once.",
        done=_AT_WORK,
        failed="failed, or with --once no branch was seen",
    )
    add_update_commands(commands, _VEHICLE, _FOLDER)
    command(
        "faults",
        _faults,
        "--json --state",
        help="why the node fell back: first, last, how often, with which currents",
        description="Prints the fault memory of a state folder, the last fault first. What is active keeps a node from "
        "correcting, also after a restart.",
    )
    command(
        "clear",
        _clear,
        "--state",
        help="forget the faults, and correct again",
        description="Empties the fault memory of a state folder. A node that runs corrects again within a second; find "
        "out first what was wrong.",
    )
    command(
        "check",
        _check,
        "--params --layout --vehicle --gateway --json",
        help="would these parameters be applied?",
        description="Checks parameters against layout, DBC and vehicle, and shows the integer plan of each branch, "
        "with --gateway as a gateway would apply it; no bus is opened. What it accepts, 'ecu-node run' accepts.",
        done="they fit",
        failed="they do not",
    )
    template = command(
        "template",
        _template,
        "--layout",
        help="print a parameter file to be filled in by hand",
        description="Prints a parameter file that fits the layout and corrects nothing yet. Where the fault of a "
        "sensor was measured, write it there: drift [1], offset_a [A, positive into the junction], and "
        '"apply": true; measured = (1 + drift) * true + offset. A load that no branch measures stands in '
        "expected_a [A], as [unmeasured_load] of the layout says. Take out branches that this vehicle does not have: "
        "the node would wait for their frames. All else can stay as it is.",
    )
    template.add_argument("--vehicle", required=True, type=_VEHICLE, metavar="ID", help="identity of the vehicle")
    command("schema", _schema, "", help="print the JSON Schema of the parameter file")
    return parser


# The commands themselves import what needs python-can, as load_python_can must come first.


def _bus_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the bus, as :func:`ecu_node.bus.adapters.bus_config` takes them."""
    names = [option.removeprefix("--").replace("-", "_") for option in _BUS.split()]
    return {name: getattr(options, name) for name in names}


def _run(options: argparse.Namespace) -> int:
    from ecu_node.bus.run import run_node  # noqa: PLC0415

    if options.gateway == options.channel:
        options.error(f"--gateway {options.gateway} is the bus of the sensors itself; two buses are expected")
    if options.gateway is not None and options.listen_only:
        options.error("--listen-only sends nothing, and a gateway must pass frames on; leave one of them out")
    if options.state is not None and options.unsigned:
        options.error("--state holds signed parameters; leave --unsigned out")
    if options.params is not None and not options.unsigned:
        options.error(
            "--params names a file that nobody signed: give --state with signed parameters, or --unsigned too"
        )
    return run_node(options, _bus_settings(options))


def _monitor(options: argparse.Namespace) -> int:
    from ecu_node.monitor import run_monitor  # noqa: PLC0415

    if options.json and options.once is None:
        options.error("--json needs --once SECONDS")
    return run_monitor(options.layout, _bus_settings(options), once_s=options.once, as_json=options.json)


def _faults(options: argparse.Namespace) -> None:
    from msgspec import to_builtins  # noqa: PLC0415

    from ecu_node.bus.faults import faults_text, read_faults  # noqa: PLC0415

    faults = read_faults(options.state)
    write_result(to_builtins(faults), faults_text(faults), as_json=options.json)


def _clear(options: argparse.Namespace) -> None:
    from ecu_node.bus.faults import clear_faults  # noqa: PLC0415

    write_output(printable(clear_faults(options.state)))


def _check(options: argparse.Namespace) -> int:
    from ecu_node.bus.run import check_report, report_text  # noqa: PLC0415

    report = check_report(options.params, options.layout, options.vehicle, is_gateway=options.gateway is not None)
    write_result(report, report_text(report), as_json=options.json)
    return 0 if report["fit"] else 1


def _template(options: argparse.Namespace) -> None:
    from ecu_node.database import node_database  # noqa: PLC0415

    write_output(template_text(node_database(options.layout), options.vehicle, datetime.now(UTC)))


def template_text(database: "VehicleDatabase", vehicle: str, now: datetime) -> str:
    """Return the content of a parameter file that corrects nothing yet.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    vehicle : str
        Identity of the vehicle.
    now : datetime
        Present date and time, with time zone.

    Returns
    -------
    str
        JSON without the keys that may be left out. The sum expected of right sensors is the layout's unmeasured load:
        it takes current out of the junction, so the measured branches sum to as much above 0 A. The verdict is
        "corrected", which holds once the file is filled in.
    """
    layout = database.layout
    expected_a = layout.unmeasured_load.mean_a if layout.unmeasured_load is not None else 0.0
    document = {
        "schema_version": 1,
        "vehicle": vehicle,
        "number": 1,
        "layout": {"name": layout.path.name, "sha256": layout.digest},
        "dbc": {"name": layout.dbc_path.name, "sha256": database.digest},
        "verdict": "corrected",
        "branches": {name: {"drift": 0.0, "offset_a": 0.0, "apply": False} for name in layout.branch_names},
        "hardware_fault": {"suspected": False},
        "junction_residual": {"measured_a": 0.0, "corrected_a": 0.0, "expected_a": expected_a},
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


def _schema(options: argparse.Namespace) -> None:  # noqa: ARG001
    from ecu_node.parameters import parameter_schema  # noqa: PLC0415

    write_output(json.dumps(parameter_schema(), indent=2))
