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
from contextlib import nullcontext
from pathlib import Path

from ecu_node import __version__
from ecu_node.command_parser import CommandParser
from ecu_node.failures import DEBUG, DEBUG_HELP, DEBUG_HINT, end_of, say_error, split_debug
from ecu_node.interrupts import ending_at_interrupt, ignoring_hangups
from ecu_node.python_can import load_python_can
from ecu_node.standard_output import drop_output, flush_output, write_output, write_text
from ecu_node.template import add_template_command
from ecu_node.trust.commands import add_trust_commands

__all__ = ["main"]

_VEHICLE_VARIABLE = "ECU_NODE_VEHICLE"
_LONGEST_ONCE_S = 86400.0
"""For ``monitor --once``. [s]"""
_LARGEST_PORT = 65535
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
    _add_check(commands)
    add_template_command(commands)
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
    run.add_argument(
        "--metrics-port", type=_port, metavar="PORT", help="let Prometheus ask here (needs prometheus-client)"
    )
    run.set_defaults(command=_run)


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
        "Kirchhoff sum, and what the node says of itself. A table in a terminal (needs rich), else a block of text "
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


def _add_layout(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--layout", type=Path, required=True, metavar="FILE", help="layout (TOML), which names the DBC")


def _add_gateway(parser: argparse.ArgumentParser, words: str) -> None:
    parser.add_argument("--gateway", type=_name, metavar="CHANNEL", help=words)


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
    from ecu_node.run import RunOptions, run_node  # noqa: PLC0415  # after load_python_can

    if options.gateway == options.channel:
        say_error(f"ecu-node: --gateway {options.gateway} is the bus of the sensors itself; two buses are expected")
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
            interface=options.interface,
            channel=options.channel,
            gateway=options.gateway,
            fd=options.fd,
            shadow=options.shadow,
            metrics_port=options.metrics_port,
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
            interface=options.interface,
            channel=options.channel,
            fd=options.fd,
            once_s=options.once,
            as_json=options.json,
        )
    )


def _check(options: argparse.Namespace) -> int:
    from ecu_node.check import check_report, report_text  # noqa: PLC0415  # after load_python_can
    from ecu_node.guard import Mode  # noqa: PLC0415

    mode = Mode.OVERLAY if options.gateway is None else Mode.GATEWAY
    report = check_report(options.params, options.layout, options.vehicle, mode)
    if options.json:
        write_output(json.dumps(report, indent=2))
    else:
        write_text(report_text(report))
    return 0 if report["fit"] else 1


def _schema(options: argparse.Namespace) -> int:  # noqa: ARG001
    from ecu_node.parameters import parameter_schema  # noqa: PLC0415  # after load_python_can

    write_output(json.dumps(parameter_schema(), indent=2))
    return 0


def _say(text: str) -> None:
    say_error(f"ecu-node: {text}")
