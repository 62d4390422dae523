"""``calibrator experiment`` and ``calibrator score``: the paper's figures and ours; a result beside its truth."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calibrator.files.folders import require_possible_folder
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption, SeedOption, WorkersOption, given_options, whole_option
from calibrator.terminal.progress import one_pass
from calibrator.terminal.text import dumps, table
from ecu_node.program import write_output

__all__ = ["experiment", "score"]

MAX_REPETITIONS = 1000


def experiment(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Experiment, or 'all'; without a name they are listed.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small and fast: shows that it runs, not the figures.")
    ] = False,
    only: Annotated[
        str | None, typer.Option("--only", metavar="TEXT", help="Only settings with this text in their name.")
    ] = None,
    repetitions: Annotated[
        int | None,
        whole_option(
            "--repetitions",
            1,
            MAX_REPETITIONS,
            "Trials per setting; without it those of the experiment, with --quick 2",
        ),
    ] = None,
    seed: SeedOption = 0,
    drives: Annotated[
        Path | None,
        typer.Option("--drives", help="Drive store, for those on recorded trips; without it the built-in vehicle."),
    ] = None,
    layout: Annotated[
        Path | None,
        typer.Option("--layout", help="Layout of these drives; without it dbc/hv_powertrain.toml of a checkout."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for NAME.md, NAME.json and NAME.png; FOLDER.md beside it lists all."),
    ] = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Run an experiment and print the paper's figures, the published method and the default side by side.

    Options that an experiment does not heed are refused.
    """
    with importing():
        from calibrator.experiments.experiments import EXPERIMENTS, fleet_for
        from calibrator.experiments.pages import result_table, write_page
        from calibrator.experiments.runner import made_now, run_experiment

    if name is None:
        write_output("\n".join(f"{row.name:<12} {row.title}" for row in EXPERIMENTS.values()))
        return
    if name not in {*EXPERIMENTS, "all"}:
        raise typer.BadParameter(f"{name}: expected one of {', '.join(EXPERIMENTS)} or all", param_hint="NAME")
    rows = list(EXPERIMENTS.values()) if name == "all" else [EXPERIMENTS[name]]
    recorded = [row for row in rows if row.recorded]
    if not recorded and (given := given_options(context, ["drives", "layout"])):
        names = ", ".join(row.name for row in EXPERIMENTS.values() if row.recorded)
        raise typer.BadParameter(f"{name} takes the built-in vehicle; this is only for {names}", param_hint=given[0])
    rows = [row.only(only) for row in rows] if only else rows
    rows = [row.small() for row in rows] if quick else rows
    if out is not None:
        require_possible_folder(out)
        require_possible_folder(out.absolute().parent)
    # recorded trips are read only once, before anything is run
    trips = fleet_for(recorded[0], quick=quick, drives=drives, layout=layout) if recorded else None
    texts, made = [], made_now()
    for number, row in enumerate(rows, start=1):
        fleet = trips if row.recorded and trips is not None else fleet_for(row, quick=quick)
        with one_pass(number, len(rows)):
            result = run_experiment(row, fleet, repetitions=repetitions, seed=seed, workers=workers)
        result = replace(result, made=made)
        texts.append(result.to_json())
        if not json:
            with (console := Console()).capture() as shown:
                console.print(result_table(result))
            write_output(shown.get(), end="")
        if out is not None:
            write_page(out, result)
    if json:
        write_output(texts[0] if len(texts) == 1 else f"[{','.join(texts)}]")


def score(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    truth: Annotated[Path, typer.Option("--truth", help="truth.json that 'calibrator simulate' wrote.")],
    json: JsonOption = False,
) -> None:
    """Compare a result with the truth of its artificial fleet."""
    with importing():
        from calibrator.experiments.result_score import WORDS, score_result

    found = score_result(result, truth)
    if json:
        write_output(dumps(found))
    else:
        rows = [(WORDS[key], f"{x:.3f}" if isinstance(x, float) else f"{x}") for key, x in found.items()]
        write_output(table(("share of vehicles", ""), rows))
