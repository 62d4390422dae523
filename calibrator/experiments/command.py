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
from calibrator.terminal.text import print_report
from ecu_node.program import write_output

__all__ = ["experiment", "score"]

REPETITIONS, QUICK_REPETITIONS, MAX_REPETITIONS = 10, 2, 1000


def experiment(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Experiment, or 'all'; without a name they are listed.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small and fast: shows that it runs, not the figures.")
    ] = False,
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
        from calibrator.errors import FleetError
        from calibrator.experiments.calibration import CALIBRATION, pool_confidences
        from calibrator.experiments.experiments import EXPERIMENTS, fleet_for, run_experiment
        from calibrator.experiments.pages import ORDER, result_table, write_result
        from calibrator.experiments.result import ExperimentResult, made_now, read_results

    if name is None:
        titles = {CALIBRATION: "Reliability of the confidence", **{row.name: row.title for row in EXPERIMENTS.values()}}
        write_output("\n".join(f"{each:<12} {titles[each]}" for each in ORDER))
        return
    if name not in {*ORDER, "all"}:
        raise typer.BadParameter(f"{name}: expected one of {', '.join(ORDER)} or all", param_hint="NAME")
    unheeded: tuple[str, ...] = ("drives", "layout", "quick", "repetitions", "seed", "workers")
    reason = "calibration runs nothing, it pools what is recorded in --out"
    if name == "all" or (name in EXPERIMENTS and EXPERIMENTS[name].recorded):
        unheeded = ()
    elif name != CALIBRATION:
        recorded = ", ".join(each for each in EXPERIMENTS if EXPERIMENTS[each].recorded)
        unheeded, reason = ("drives", "layout"), f"{name} takes the built-in vehicle; this is only for {recorded}"
    if given := given_options(context, unheeded):
        raise typer.BadParameter(reason, param_hint=given[0])
    if name == CALIBRATION and out is None:
        raise typer.BadParameter(
            "calibration pools what is recorded there; first run 'calibrator experiment all --out FOLDER', or some "
            "experiments by their names",
            param_hint="--out",
        )
    if out is not None:
        require_possible_folder(out)
        require_possible_folder(out.absolute().parent)
    names = ORDER if name == "all" else (name,)
    # recorded trips are read before anything is run, and once
    trips = next((e for each, e in EXPERIMENTS.items() if each in names and e.recorded), None)
    fleet = None if trips is None else fleet_for(trips, quick=quick, drives=drives, layout=layout)
    count = repetitions or (QUICK_REPETITIONS if quick else REPETITIONS)
    done: list[ExperimentResult] = []
    for number, each in enumerate(names, start=1):
        with one_pass(number, len(names)):
            if each == CALIBRATION:
                before = [] if out is None else read_results(out, EXPERIMENTS)
                pooled = {result.name: result for result in (*before, *done)}
                if not pooled:
                    raise FleetError(
                        f"{out}: no experiment is recorded that calibration could pool; first run 'calibrator "
                        f"experiment all --out {out}', or some experiments by their names"
                    )
                result = pool_confidences(list(pooled.values()))
            else:
                row = EXPERIMENTS[each]
                own = fleet if row.recorded and fleet is not None else fleet_for(row, quick=quick)
                result = run_experiment(
                    row.small() if quick else row, own, repetitions=count, seed=seed, workers=workers
                )
        done.append(replace(result, made=made_now()))
        if not json:
            Console().print(result_table(done[-1]))
        if out is not None:
            write_result(out, done[-1])
    if json:
        texts = [result.to_json().decode().rstrip() for result in done]
        write_output(texts[0] if len(texts) == 1 else f"[{','.join(texts)}]")


def score(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    truth: Annotated[Path, typer.Option("--truth", help="truth.json that 'calibrator simulate' wrote.")],
    json: JsonOption = False,
) -> None:
    """Compare a result with the truth of its artificial fleet."""
    with importing():
        from calibrator.experiments.result_score import score_result

    print_report(score_result(result, truth), json=json)
