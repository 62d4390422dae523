"""Command line of the calibrator. Results go to stdout, progress and messages to stderr."""

import os
import sys
from collections.abc import Callable
from itertools import chain
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from calibrator.artificial.command import simulate
from calibrator.doctor.command import doctor
from calibrator.estimator.command import calibrate, identify, params
from calibrator.estimator.settings import time_of_run
from calibrator.experiments.command import experiment, score
from calibrator.export.command import export
from calibrator.kirchhoff.command import kirchhoff
from calibrator.proposal.command import layout
from calibrator.recordings.command import replay
from calibrator.report.command import report
from calibrator.repository.command import repository
from calibrator.sources.command import import_
from calibrator.summaries.command import store_app, summarise
from calibrator.terminal.command_line import command_app, example, run_app
from ecu_node import __version__
from ecu_node.program import write_output

__all__ = ["app", "run_calibrator"]

COMMANDS: dict[str, dict[str, tuple[Callable[..., None] | typer.Typer, list[str]]]] = {
    "Commands to look at a recording": {
        "layout": (layout, ["layout init my_car.dbc --out my_car.toml"]),
        "doctor": (doctor, ["doctor --layout my_car.toml --log drive.blf"]),
        "kirchhoff": (
            kirchhoff,
            [
                "kirchhoff table.csv --branches battery=Ibat,-motor=Imot --plot sum.html",
                "kirchhoff drive.blf --layout my_car.toml --plot sum.html",
            ],
        ),
        "replay": (replay, ["replay drive.log --interface socketcan --channel vcan0"]),
    },
    "Commands to calibrate": {
        "import": (import_, ["import logs --layout my_car.toml --out store"]),
        "summarise": (summarise, ["summarise store --layout my_car.toml --out summaries"]),
        "store": (store_app, ["store info summaries"]),
        "calibrate": (
            calibrate,
            [
                "calibrate drive.csv --layout my_car.toml --trusted battery --out result",
                "calibrate fleet --layout my_car.toml --out result",
            ],
        ),
        "params": (params, ["params result V001 V002 --out params"]),
        "report": (report, ["report result"]),
        "export": (export, ["export result/params/V001.json --layout my_car.toml --format c --out hv_calibration.c"]),
    },
    "Commands to bring parameters to vehicles": {"repository": (repository, ["repository add repo result/params"])},
    "Commands for research": {
        "simulate": (simulate, ["simulate --layout dbc/hv_powertrain.toml --vehicles 40 --currents 3 --out fleet"]),
        "identify": (identify, ["identify store --layout my_car.toml --out bank.json"]),
        "score": (score, ["score result --truth fleet/truth.json"]),
        "experiment": (experiment, ["experiment sparsity --repetitions 2"]),
    },
}
"""Commands with examples in the order of use, by the heading under which ``--help`` lists them."""


class _InOrder(TyperGroup):
    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 (typer's signature)
        width = max(map(len, self.commands))
        for heading, names in COMMANDS.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), self.commands[name].short_help) for name in names])


app = command_app(
    cls=_InOrder,
    add_completion=True,
    no_args_is_help=True,
    epilog=example("calibrator kirchhoff table.csv --branches battery=Ibat,-motor=Imot"),
)
for name, (command, lines) in chain.from_iterable(commands.items() for commands in COMMANDS.values()):
    epilog = example(*(f"calibrator {line}" for line in lines))
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=name, epilog=epilog)
    else:
        app.command(name, epilog=epilog)(command)


def run_calibrator() -> int:
    """Run the command line and return its exit code, see :data:`calibrator.terminal.command_line.EXIT_CODES`."""
    if not os.environ.get("SOURCE_DATE_EPOCH"):
        os.environ.pop("SOURCE_DATE_EPOCH", None)
    time_of_run()  # numpy fails at its import if SOURCE_DATE_EPOCH is empty or no number
    return run_app(app, "calibrator", sys.argv[1:])


def _version(wanted: bool) -> None:
    if wanted:
        write_output(f"calibrator {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error; may stand anywhere.")] = False,
) -> None:
    """Find out what current sensors do wrong, from recordings of one junction or of a fleet of vehicles."""
