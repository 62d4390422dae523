"""Calibration from drives by the published method."""

from dataclasses import replace

from calibrator.calibration.in_order import Workers
from calibrator.calibration.report import CalibrationReport
from calibrator.calibration.run_facts import FleetFacts, run_identity
from calibrator.calibration.unfinished import Unfinished
from calibrator.calibration.write_result import write_result
from calibrator.calibration_settings import CalibrationSettings
from calibrator.published.fleet import calibrate_fleet_published
from calibrator.results.chunk import encode_chunk
from calibrator.sources.fleet_source import FleetSource, probe_equipment
from calibrator.time_of_run import time_of_run
from ecu_node.database import VehicleDatabase

__all__ = ["calibrate_published"]


def calibrate_published(
    unfinished: Unfinished,
    fleet: FleetSource,
    database: VehicleDatabase,
    settings: CalibrationSettings,
    *,
    workers: Workers,
) -> CalibrationReport:
    """The published method needs all models at once; its result is one chunk."""
    equipment = probe_equipment(fleet, database, settings.branches, limit_s=settings.time_limit_s)
    about = FleetFacts.of_drives(fleet, equipment)
    identity = run_identity(about, database, settings, created=unfinished.begin(None, time_of_run()))
    outcome = calibrate_fleet_published(fleet, equipment, identity, settings, workers=workers.processes)
    unfinished.chunks.put(0, encode_chunk(outcome.parameters, outcome.left_out))
    about = replace(about, left_out={})
    return write_result(unfinished, about, identity, settings, details=outcome.details, notices=outcome.notices)
