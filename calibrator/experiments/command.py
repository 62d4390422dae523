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

REPETITIONS, QUICK_REPETITIONS, MAX_REPETITIONS = 10, 2, 1000


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
        whole_option("--repetitions", 1, MAX_REPETITIONS, "Trials per setting (without it 10, with --quick 2)"),
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

    'calibration' runs nothing: it pools the confidences of the experiments that were recorded in --out before. Options
    that an experiment does not heed are refused.
    """
    with importing():
        from calibrator.experiments.experiments import (
            CALIBRATION,
            EXPERIMENTS,
            ExperimentResult,
            fleet_for,
            read_records,
        )
        from calibrator.experiments.pages import result_table, write_page
        from calibrator.experiments.runner import made_now, pool_confidences, run_experiment

    if name is None:
        write_output("\n".join(f"{row.name:<12} {row.title}" for row in EXPERIMENTS.values()))
        return
    if name not in {*EXPERIMENTS, "all"}:
        raise typer.BadParameter(f"{name}: expected one of {', '.join(EXPERIMENTS)} or all", param_hint="NAME")
    rows = list(EXPERIMENTS.values()) if name == "all" else [EXPERIMENTS[name]]
    recorded = [row for row in rows if row.recorded]
    names = ", ".join(row.name for row in EXPERIMENTS.values() if row.recorded)
    unheeded, reason = ["drives", "layout"], f"{name} takes the built-in vehicle; this is only for {names}"
    if rows == [CALIBRATION]:
        unheeded += ["quick", "only", "repetitions", "seed", "workers"]
        reason = "calibration runs nothing, it pools what is recorded in --out"
    if not recorded and (given := given_options(context, unheeded)):
        raise typer.BadParameter(reason, param_hint=given[0])
    rows = [row.only(only) for row in rows] if only else rows
    if rows == [CALIBRATION] and out is None:
        first = "first run 'calibrator experiment all --out FOLDER', or some experiments by their names"
        raise typer.BadParameter(f"calibration pools what is recorded there; {first}", param_hint="--out")
    if out is not None:
        require_possible_folder(out)
        require_possible_folder(out.absolute().parent)
    # recorded trips are read only once, before anything is run
    trips = fleet_for(recorded[0], quick=quick, drives=drives, layout=layout) if recorded else None
    count = repetitions or (QUICK_REPETITIONS if quick else REPETITIONS)
    done: dict[str, ExperimentResult] = {}
    for number, row in enumerate(rows, start=1):
        with one_pass(number, len(rows)):
            if row is CALIBRATION:
                result = pool_confidences(read_records(out, EXPERIMENTS) if out else [*done.values()])
            else:
                fleet = trips if row.recorded and trips is not None else fleet_for(row, quick=quick)
                small = row.small() if quick else row
                result = run_experiment(small, fleet, repetitions=count, seed=seed, workers=workers)
        done[row.name] = result = replace(result, made=made_now())
        if not json:
            Console().print(result_table(result))
        if out is not None:
            write_page(out, result)
    if json:
        texts = [result.to_json() for result in done.values()]
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
