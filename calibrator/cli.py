"""Command line of the calibrator. Results go to stdout, progress and messages to stderr."""

import sys
from itertools import chain
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from calibrator.artificial.command import simulate
from calibrator.doctor.command import doctor
from calibrator.estimator.command import calibrate, identify, params
from calibrator.experiments.command import experiment, score
from calibrator.export.command import export
from calibrator.kirchhoff.command import kirchhoff
from calibrator.proposal.command import layout as layout_commands
from calibrator.recordings.command import replay
from calibrator.report.command import report
from calibrator.repository.command import repository
from calibrator.sources.command import import_
from calibrator.summaries.command import store_app, summarise
from calibrator.terminal.command_line import command_app, example, run_app
from ecu_node import __version__

__all__ = ["app", "main"]

ORDER = {
    "Commands to look at a recording": ("layout", "doctor", "kirchhoff", "replay"),
    "Commands to calibrate": ("import", "summarise", "store", "calibrate", "params", "report", "export"),
    "Commands to bring parameters to vehicles": ("repository",),
    "Commands for research": ("simulate", "identify", "score", "experiment"),
}
"""Commands in the order of use, by the heading under which ``--help`` lists them."""


class _InOrder(TyperGroup):
    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002 (typer's signature)
        return list(chain.from_iterable(ORDER.values()))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        width = max(map(len, self.list_commands(None)))
        for heading, names in ORDER.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), self.commands[name].short_help) for name in names])


app = command_app(
    cls=_InOrder,
    add_completion=True,
    no_args_is_help=True,
    epilog=example("calibrator kirchhoff table.csv --branches battery=Ibat,-motor=Imot"),
)
app.add_typer(layout_commands, name="layout", epilog=example("calibrator layout init my_car.dbc --out my_car.toml"))
app.add_typer(store_app, name="store", epilog=example("calibrator store info summaries"))
app.add_typer(repository, name="repository", epilog=example("calibrator repository add repo result/params"))
for function, lines in (
    (doctor, ["calibrator doctor --layout my_car.toml --log drive.blf"]),
    (
        kirchhoff,
        [
            "calibrator kirchhoff table.csv --branches battery=Ibat,-motor=Imot --plot sum.html",
            "calibrator kirchhoff drive.blf --layout my_car.toml --plot sum.png",
        ],
    ),
    (replay, ["calibrator replay drive.log --interface socketcan --channel vcan0"]),
    (summarise, ["calibrator summarise store --layout my_car.toml --out summaries"]),
    (
        calibrate,
        [
            "calibrator calibrate drive.csv --layout my_car.toml --trusted battery --out result",
            "calibrator calibrate fleet --layout my_car.toml --out result",
        ],
    ),
    (params, ["calibrator params result V001 V002 --out params"]),
    (report, ["calibrator report result"]),
    (export, ["calibrator export result/params/V001.json --layout my_car.toml --format c --out hv_calibration.c"]),
    (simulate, ["calibrator simulate --layout dbc/hv_powertrain.toml --vehicles 40 --currents 3 --out fleet"]),
    (identify, ["calibrator identify store --layout my_car.toml --out bank.json"]),
    (score, ["calibrator score result --truth fleet/truth.json"]),
    (experiment, ["calibrator experiment sparsity --repetitions 2"]),
):
    app.command(epilog=example(*lines))(function)
app.command("import", epilog=example("calibrator import logs --layout my_car.toml --out store"))(import_)


def main() -> int:
    """Run the command line and return its exit code, see :data:`calibrator.terminal.command_line.EXIT_CODES`."""
    return run_app(app, "calibrator", sys.argv[1:])


def _version(wanted: bool) -> None:
    if wanted:
        print(f"calibrator {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error; may stand anywhere.")] = False,
) -> None:
    """Find out what current sensors do wrong, from recordings of one junction or of a fleet of vehicles."""
