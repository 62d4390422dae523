"""Command line of the node: ``ecu-node run``, ``ecu-node monitor``, ``ecu-node check``, ``ecu-node template``.

Results go to standard output, what happens to standard error. Exit code 0: done, 1: failed, 2: wrong use,
70: a fault of the program itself, 130: interrupted by Ctrl-C before the node was at work (at work, Ctrl-C and SIGTERM
end it with 0). Errors are one line; ``--debug``, anywhere, shows the traceback as well.
"""

import argparse
import json
import logging
import math
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ecu_node import __version__
from ecu_node.program import (
    DEBUG,
    DEBUG_HELP,
    DEBUG_HINT,
    CommandParser,
    drop_output,
    end_of,
    ending_at_interrupt,
    flush_output,
    ignoring_hangups,
    load_python_can,
    say_error,
    split_debug,
    write_output,
    write_text,
)
from ecu_node.trust.commands import add_trust_commands

__all__ = ["main"]

_VEHICLE_VARIABLE = "ECU_NODE_VEHICLE"
_LONGEST_ONCE_S = 86400.0
"""For ``monitor --once``. [s]"""
_LARGEST_PORT = 65535
_LONGEST_VEHICLE = 64
"""Characters, as in the parameter file."""
_EXIT_CODES = (
    "Exit codes: 0 done (also when ended by a signal), 1 failed, 2 wrong use, 70 internal error, 130 interrupted at "
    "start."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

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
    arguments, debug = split_debug(sys.argv[1:] if argv is None else argv)
    try:
        with ending_at_interrupt("ecu-node: interrupted"):
            try:
                return _main(arguments)
            finally:
                flush_output()
    except BrokenPipeError:
        drop_output()
        return 1
    except Exception as error:  # noqa: BLE001 (each is told, and ends the program)
        return end_of("ecu-node", error, debug=debug)


def _main(arguments: Sequence[str]) -> int:
    options = _parser().parse_args(arguments)
    with ignoring_hangups() if options.command is _run else nullcontext():
        logging.getLogger("can").addHandler(logging.NullHandler())
        load_python_can()
        return int(options.command(options))


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="ecu-node",
        description="Corrects the high-voltage currents on a CAN bus with the parameters of this vehicle.",
        epilog=_EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument(DEBUG, action="store_true", help=DEBUG_HELP)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_run(commands)
    _add_monitor(commands)
    add_trust_commands(commands)
    _add_faults(commands)
    _add_check(commands)
    _add_template(commands)
    schema = commands.add_parser("schema", help="print the JSON Schema of the parameter file")
    schema.set_defaults(command=_schema)
    for command in commands.choices.values():
        command.epilog = f"{command.epilog or _EXIT_CODES} {DEBUG_HINT}"
    return parser


def _add_run(commands: "argparse._SubParsersAction[CommandParser]") -> None:
    run = commands.add_parser(
        "run",
        help="correct until SIGTERM or SIGINT",
        description="Reads the branch currents from a bus and publishes them corrected, under identifiers of their "
        "own on the same bus, or, with --gateway, in place on another bus. With parameters that do not fit it passes "
        "the measured values through and says so in its status message. SIGHUP, or a changed parameter file, makes it "
        "read the parameters again.",
        epilog=_EXIT_CODES,
    )
    source = run.add_mutually_exclusive_group(required=True)
    source.add_argument("--state", type=Path, metavar="FOLDER", help="state of this vehicle, with signed parameters")
    source.add_argument("--params", type=Path, metavar="FILE", help="parameter file that nobody signed; --unsigned")
    run.add_argument("--unsigned", action="store_true", help="use parameters that nobody signed, as on a test bench")
    _add_layout(run)
    _add_vehicle(run)
    _add_bus(run)
    _add_gateway(
        run,
        "be a gateway: the sensors are on --channel, the rest of the vehicle on this; branch frames are passed on with "
        "the corrected current in place, all others as they are",
    )
    run.add_argument("--shadow", action="store_true", help="compute and report the corrected sum, but change nothing")
    run.add_argument("--dry-run", action="store_true", help="print what would be opened, read and sent; open nothing")
    run.add_argument(
        "--metrics-port", type=_port, metavar="PORT", help="let Prometheus ask here (needs prometheus-client)"
    )
    run.add_argument(
        "--telemetry",
        type=_outlet,
        metavar="TARGET",
        help="a line of JSON per second, added to a file or sent to udp://HOST:PORT",
    )
    run.add_argument(
        "--realtime", action="store_true", help="run as a real-time process: SCHED_FIFO, locked memory, one processor"
    )
    run.set_defaults(command=_run)


def _add_faults(commands: "argparse._SubParsersAction[CommandParser]") -> None:
    faults = commands.add_parser(
        "faults",
        help="why the node fell back: first, last, how often, with which currents",
        description="Prints the fault memory of a state folder, the last fault first. What is active keeps a node from "
        "correcting, also after a restart.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong use, 70 internal error, 130 interrupted.",
    )
    faults.add_argument("--json", action="store_true", help="print JSON")
    clear = commands.add_parser(
        "clear",
        help="forget the faults, and correct again",
        description="Empties the fault memory of a state folder. A node that runs corrects again within a second; find "
        "out first what was wrong.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong use, 70 internal error, 130 interrupted.",
    )
    for command, run in ((faults, _faults), (clear, _clear)):
        command.add_argument("--state", type=Path, required=True, metavar="FOLDER", help="state of this vehicle")
        command.set_defaults(command=run)


def _add_check(commands: "argparse._SubParsersAction[CommandParser]") -> None:
    check = commands.add_parser(
        "check",
        help="would these parameters be applied?",
        description="Checks parameters against layout, DBC and vehicle, and shows the integer plan of each branch. "
        "What it accepts, 'ecu-node run' accepts.",
        epilog="Exit codes: 0 they fit, 1 they do not, 2 wrong use, 70 internal error, 130 interrupted.",
    )
    _add_files(check)
    _add_gateway(check, "as a gateway would apply them; no bus is opened")
    check.add_argument("--json", action="store_true", help="print JSON")
    check.set_defaults(command=_check)


def _add_monitor(commands: "argparse._SubParsersAction[CommandParser]") -> None:
    monitor = commands.add_parser(
        "monitor",
        help="show the branches, their sum and the node, live",
        description="Listens to a bus, and never sends: measured and corrected currents, frame rates, faults, the "
        "Kirchhoff sum, and what the node says of itself. A table in a terminal, else a block of text "
        "per second.",
        epilog="Exit codes: 0 done (also when ended by a signal), 1 failed, or with --once no branch was seen, "
        "2 wrong use, 70 internal error, 130 interrupted at start.",
    )
    _add_layout(monitor)
    _add_bus(monitor)
    monitor.add_argument(
        "--once", type=_seconds, metavar="SECONDS", help="listen this long, print what was seen, and end"
    )
    monitor.add_argument("--json", action="store_true", help="print JSON; with --once")
    monitor.set_defaults(command=_monitor, error=monitor.error)


def _add_template(commands: "argparse._SubParsersAction[CommandParser]") -> None:
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
    _add_layout(template)
    template.add_argument(
        "--vehicle", required=True, type=_template_vehicle, metavar="ID", help="identity of the vehicle"
    )
    template.set_defaults(command=_template)


def _template_vehicle(text: str) -> str:
    if not text.strip() or len(text) > _LONGEST_VEHICLE or not text.isprintable():
        raise argparse.ArgumentTypeError(
            f"the identity of the vehicle is expected, of at most {_LONGEST_VEHICLE} characters that can be printed"
        )
    return text


def _seconds(text: str) -> float:
    """A time of the command line. [s]"""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds <= _LONGEST_ONCE_S:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a number of seconds above 0, at most {_LONGEST_ONCE_S:g}")
    return seconds


def _add_bus(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--interface", default="socketcan", help="python-can interface (default: %(default)s)")
    parser.add_argument("--channel", required=True, type=_name, help="channel of the interface, such as can0 or vcan0")
    parser.add_argument("--fd", action="store_true", help="open the bus for CAN FD")
    for name, what in (("--bitrate", "bit rate"), ("--data-bitrate", "bit rate of the data of CAN FD frames")):
        parser.add_argument(
            name,
            type=int,
            metavar="BIT_PER_S",
            help=f"{what}, where the adapter sets it; this and other settings may stand in python-can's can.conf",
        )
    parser.add_argument(
        "--listen-only", action="store_true", help="send nothing; adapters that can do so acknowledge no frame either"
    )


def _add_layout(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--layout", type=Path, required=True, metavar="FILE", help="layout (TOML), which names the DBC")


def _add_gateway(parser: argparse.ArgumentParser, words: str) -> None:
    parser.add_argument("--gateway", type=_name, metavar="CHANNEL", help=words)


def _bus_options(options: argparse.Namespace) -> dict[str, Any]:
    """What :func:`_add_bus` has added, as the options of a run or a monitor."""
    return {
        "interface": options.interface,
        "channel": options.channel,
        "fd": options.fd,
        "listen_only": options.listen_only,
        "bitrates": {"bitrate": options.bitrate, "data_bitrate": options.data_bitrate},
    }


def _name(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("a name is expected, such as can0, found none")
    return text


def _vehicle(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("the identity of this vehicle is expected, found none; or leave it out")
    if not text.isprintable():
        raise argparse.ArgumentTypeError(f"{text!a}: the identity of this vehicle is a text without control characters")
    return text


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= _LARGEST_PORT:
        raise argparse.ArgumentTypeError(f"a TCP port from 1 to {_LARGEST_PORT} is expected, found {text!r}")
    return int(text)


def _outlet(text: str) -> Path | tuple[str, int]:
    if text.strip() and "://" not in text:
        return Path(text)
    with suppress(ValueError):  # a port that is none
        found = urlsplit(text)
        if found.scheme == "udp" and found.hostname and found.port and text.endswith(f":{found.port}"):
            return found.hostname, found.port
    raise argparse.ArgumentTypeError(f"a file or udp://HOST:PORT is expected, found {text!r}")


def _add_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--params", type=Path, required=True, metavar="FILE", help="parameter file of this vehicle")
    _add_layout(parser)
    _add_vehicle(parser)


def _add_vehicle(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--vehicle",
        type=_vehicle,
        default=os.environ.get(_VEHICLE_VARIABLE) or None,
        metavar="ID",
        help=f"this vehicle; parameters of another are refused (default: ${_VEHICLE_VARIABLE}; else not checked)",
    )


def _run(options: argparse.Namespace) -> int:
    from ecu_node.bus.run import RunOptions, run_node  # noqa: PLC0415  # after load_python_can

    if options.gateway == options.channel:
        say_error(f"ecu-node: --gateway {options.gateway} is the bus of the sensors itself; two buses are expected")
        return 2
    if options.gateway is not None and options.listen_only:
        _say("--listen-only sends nothing, and a gateway must pass frames on; leave one of them out")
        return 2
    if (options.params is not None) != options.unsigned:
        _say(
            "--state holds signed parameters; leave --unsigned out"
            if options.unsigned
            else "--params names a file that nobody signed: give --state with signed parameters, or --unsigned as well"
        )
        return 2
    return run_node(
        RunOptions(
            params=options.params,
            state=options.state,
            layout=options.layout,
            vehicle=options.vehicle,
            **_bus_options(options),
            gateway=options.gateway,
            shadow=options.shadow,
            dry_run=options.dry_run,
            metrics_port=options.metrics_port,
            telemetry=options.telemetry,
            realtime=options.realtime,
        ),
        vehicle_hint=f"give --vehicle or ${_VEHICLE_VARIABLE}",
    )


def _monitor(options: argparse.Namespace) -> int:
    from ecu_node.monitor import MonitorOptions, run_monitor  # noqa: PLC0415  # after load_python_can

    if options.json and options.once is None:
        options.error("--json needs --once SECONDS")
    return run_monitor(
        MonitorOptions(
            layout=options.layout,
            **_bus_options(options),
            once_s=options.once,
            as_json=options.json,
        )
    )


def _check(options: argparse.Namespace) -> int:
    from ecu_node.bus.guard import Mode  # noqa: PLC0415
    from ecu_node.check import check_report, report_text  # noqa: PLC0415  # after load_python_can

    mode = Mode.OVERLAY if options.gateway is None else Mode.GATEWAY
    report = check_report(options.params, options.layout, options.vehicle, mode)
    if options.json:
        write_output(json.dumps(report, indent=2))
    else:
        write_text(report_text(report))
    return 0 if report["fit"] else 1


def _faults(options: argparse.Namespace) -> int:

    from ecu_node.bus.faults import faults_text, read_faults  # noqa: PLC0415  # after load_python_can

    faults = read_faults(options.state)
    if options.json:
        write_output(
            json.dumps([{name: getattr(fault, name) for name in fault.__struct_fields__} for fault in faults], indent=2)
        )
    else:
        write_text(faults_text(faults))
    return 0


def _clear(options: argparse.Namespace) -> int:
    from ecu_node.bus.faults import clear_faults  # noqa: PLC0415  # after load_python_can

    clear_faults(options.state)
    return 0


def _template(options: argparse.Namespace) -> int:
    from ecu_node.check import template_text  # noqa: PLC0415  # after load_python_can
    from ecu_node.database import node_database  # noqa: PLC0415

    write_output(template_text(node_database(options.layout), options.vehicle, datetime.now(UTC)))
    return 0


def _schema(options: argparse.Namespace) -> int:  # noqa: ARG001
    from ecu_node.parameters import parameter_schema  # noqa: PLC0415  # after load_python_can

    write_output(json.dumps(parameter_schema(), indent=2))
    return 0


def _say(text: str) -> None:
    say_error(f"ecu-node: {text}")
