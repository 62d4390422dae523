"""Command line of the calibrator. Results go to stdout, progress and messages to stderr."""

import sys
from typing import Annotated

import typer

from calibrator.artificial.command import simulate
from calibrator.doctor.command import doctor
from calibrator.estimator.command import calibrate, params
from calibrator.estimator.identify_command import identify
from calibrator.experiments.command import experiment, score
from calibrator.export.command import export
from calibrator.kirchhoff.command import kirchhoff
from calibrator.proposal.command import layout as layout_commands
from calibrator.recordings.command import replay
from calibrator.report.command import report
from calibrator.signing.command import keys, revoke, sign
from calibrator.sources.command import import_
from calibrator.summaries.command import summarise
from calibrator.terminal.command_line import command_app, run_app
from ecu_node import __version__

__all__ = ["app", "main"]

app = command_app(
    help="Learn from recorded drives what each vehicle's high-voltage current sensors do wrong.", no_args_is_help=True
)
app.add_typer(keys, name="keys")
app.add_typer(layout_commands, name="layout")
app.command()(sign)
app.command()(revoke)
app.command()(doctor)
app.command()(kirchhoff)
app.command()(replay)
app.command("import")(import_)
app.command()(simulate)
app.command()(summarise)
app.command()(identify)
app.command()(calibrate)
app.command()(params)
app.command()(export)
app.command()(report)
app.command()(score)
app.command()(experiment)


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
    """Learn from recorded drives what each vehicle's high-voltage current sensors do wrong."""
