"""The chunks of a run become its result."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from calibrator.calibration.report import MOST_NAMED, CalibrationReport, report_of
from calibrator.calibration.run_facts import FleetFacts
from calibrator.calibration.unfinished import Unfinished
from calibrator.calibration_settings import CalibrationSettings
from calibrator.errors import FleetError
from calibrator.files.parameter_files import RunIdentity
from calibrator.results.left_out import left_out_of
from calibrator.results.parameter_parts import write_parameter_files
from calibrator.results.rows import join_rows
from calibrator.results.run_record import RunRecord, write_run
from calibrator.summaries.unity import UNITY_FILE
from calibrator.terminal.progress import progress_bar
from ecu_node.user_files import write_atomically

__all__ = ["write_result"]


def write_result(
    unfinished: Unfinished,
    fleet: FleetFacts,
    identity: RunIdentity,
    settings: CalibrationSettings,
    *,
    details: Mapping[str, object],
    notices: Sequence[str],
    summaries: Path | None = None,
    window: bytes | None = None,
    buckets: int = 0,
) -> CalibrationReport:
    """Put the chunks together."""
    chunks, folder = unfinished.chunks, unfinished.result()
    numbers = chunks.numbers()
    vehicles = join_rows(folder, [chunks.rows(number) for number in numbers], fleet.left_out)
    left_out, left_out_count = left_out_of(folder, most=MOST_NAMED)
    if not vehicles:
        why = next(iter(left_out.values()), "there is none")
        raise FleetError(f"{fleet.name}: no vehicle can be calibrated; the first: {why}")
    with progress_bar("write the result", None):
        where = write_parameter_files(folder, {n: chunks.parameters(n) for n in numbers}, vehicles=vehicles)
    if summaries is not None:
        shutil.copytree(summaries, folder / summaries.name, ignore=shutil.ignore_patterns(".*"))
    if window is not None:
        write_atomically(folder / UNITY_FILE, window)
    run = RunRecord(
        tool=identity.tool,
        method=identity.method.value,
        fleet=identity.fleet,
        fleet_ids=list(fleet.fleet_ids),
        layout=identity.database.layout.name,
        branches=list(fleet.equipment.branches),
        model_inputs=list(fleet.equipment.inputs),
        settings=settings.record(),
        created=identity.created,
        details=dict(details),
        vehicles=vehicles,
        buckets=buckets,
        left_out=left_out,
        left_out_count=left_out_count,
        full_scale_a=identity.database.layout.full_scale_a,
        layout_sha256=identity.database.layout.digest,
        dbc_sha256=identity.database.digest,
        notices=[*fleet.notices, *notices],
    )
    write_run(folder, run)
    report = report_of(folder, run, parameters=where, shown=unfinished.shown)
    unfinished.finish()
    return report
