"""``calibrator experiment`` and ``calibrator score``: the paper's figures and ours; a result beside its truth."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calibrator.files.folders import require_possible_folder
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption, SeedOption, WorkersOption, given_options, whole_option
from calibrator.terminal.text import print_report
from ecu_node.program import write_output

__all__ = ["RECORDED_EXPERIMENTS", "ExperimentName", "experiment", "score"]


class ExperimentName(StrEnum):
    """Experiments of the paper (table 1, figure 7, figure 8, table 2), those beyond it, and all of them."""

    CLASSIFIER = "classifier"
    SNR = "snr"
    SPARSITY = "sparsity"
    STATESPACE = "statespace"
    ASYMMETRY = "asymmetry"
    REAL = "real"
    DELAY = "delay"
    DATA = "data"
    PHASE = "phase"
    ATTACKS = "attacks"
    COVERAGE = "coverage"
    CALIBRATION = "calibration"
    ALL = "all"


RECORDED_EXPERIMENTS = (
    ExperimentName.REAL, ExperimentName.DELAY, ExperimentName.DATA, ExperimentName.PHASE, ExperimentName.ATTACKS,
    ExperimentName.COVERAGE,
)  # fmt: skip
"""Those on recorded trips; the others take the built-in vehicle."""
RECORDED_OPTIONS = ("drives", "layout")
"""What only experiments on recorded trips heed."""
RUN_OPTIONS = (*RECORDED_OPTIONS, "quick", "repetitions", "seed", "workers")
"""What only experiments that run something heed."""
MAX_REPETITIONS = 1000
QuickOption = Annotated[bool, typer.Option("--quick", help="Small and fast: shows that it runs, not the figures.")]
RepetitionsOption = Annotated[
    int | None,
    whole_option("--repetitions", 1, MAX_REPETITIONS, "Trials per setting (without it 10, with --quick 2)"),
]
ExperimentDrivesOption = Annotated[
    Path | None,
    typer.Option(
        "--drives", help=f"Drive store for {', '.join(RECORDED_EXPERIMENTS)}; without it the built-in vehicle."
    ),
]
ExperimentLayoutOption = Annotated[
    Path | None,
    typer.Option("--layout", help="Layout of these drives; without it dbc/hv_powertrain.toml of a checkout."),
]
ResultsFolderOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for NAME.md, NAME.json and NAME.png; FOLDER.md beside it lists all."),
]


def experiment(
    context: typer.Context,
    name: Annotated[
        ExperimentName, typer.Argument(show_choices=False, help=f"Experiment: {', '.join(ExperimentName)}.")
    ],
    quick: QuickOption = False,
    repetitions: RepetitionsOption = None,
    seed: SeedOption = 0,
    drives: ExperimentDrivesOption = None,
    layout: ExperimentLayoutOption = None,
    out: ResultsFolderOption = None,
    workers: WorkersOption = 2,
    json: JsonOption = False,
) -> None:
    """Run an experiment and print the paper's figures, the published method and the default side by side.

    'calibration' runs nothing: it pools the confidences of the experiments that were recorded in --out before. Options
    that an experiment does not heed are refused.
    """
    require_heeded_options(context, name)
    with importing():
        from calibrator.experiments.runner import CALIBRATION, EXPERIMENTS, RunOptions, run_experiments

    if out is not None:
        require_possible_folder(out)
        require_possible_folder(out.absolute().parent)
    names = (*EXPERIMENTS, CALIBRATION) if name is ExperimentName.ALL else (name.value,)
    options = RunOptions(quick=quick, seed=seed, repetitions=repetitions, jobs=workers, layout=layout, drives=drives)
    results = run_experiments(names, options, out=out, console=None if json else Console())
    if json:
        texts = [result.to_json().decode().rstrip() for result in results]
        write_output(texts[0] if len(texts) == 1 else f"[{','.join(texts)}]")


def score(
    result: Annotated[Path, typer.Argument(help="Folder that 'calibrator calibrate' wrote.")],
    truth: Annotated[Path, typer.Option("--truth", help="truth.json that 'calibrator simulate' wrote.")],
    json: JsonOption = False,
) -> None:
    """Compare a result with the truth of its artificial fleet."""
    with importing():
        from calibrator.experiments.result_score import score_result

    figures = score_result(result, truth)
    print_report(figures, json=json)


def require_heeded_options(context: typer.Context, name: ExperimentName) -> None:
    """Refuse options that an experiment does not heed, and ``calibration`` without the folder that it pools.

    Parameters
    ----------
    context : typer.Context
        Of the command.
    name : ExperimentName
        The experiment; all together heed every option.

    Raises
    ------
    typer.BadParameter
        Naming the first such option.
    """
    unheeded: tuple[str, ...] = ()
    reason = ""
    if name is ExperimentName.CALIBRATION:
        unheeded, reason = RUN_OPTIONS, "calibration runs nothing, it pools what is recorded in --out"
    elif name not in (*RECORDED_EXPERIMENTS, ExperimentName.ALL):
        unheeded = RECORDED_OPTIONS
        reason = f"{name.value} takes the built-in vehicle; this is only for {', '.join(RECORDED_EXPERIMENTS)}"
    given = given_options(context, unheeded)
    if given:
        raise typer.BadParameter(reason, param_hint=given[0])
    if name is ExperimentName.CALIBRATION and context.params["out"] is None:
        raise typer.BadParameter(
            "calibration pools what is recorded there; first run 'calibrator experiment all --out FOLDER', or some "
            "experiments by their names",
            param_hint="--out",
        )
