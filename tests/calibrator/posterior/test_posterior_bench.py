"""Bench readings beside trust and zero-current windows: contradictions are named, and nothing is averaged over them."""

from pathlib import Path

import numpy as np
import pytest

from calibrator.calibration_settings import CalibrationSettings
from calibrator.drives.delays import BranchDelays
from calibrator.errors import FleetError
from calibrator.posterior.bench import merge_readings, read_bench
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.summaries.zero_current import ZeroCurrent
from tests.calibrator.evidence.simulated_drives import no_faults, summaries_of

BRANCHES = ("battery", "motor")
VEHICLES = ("V1", "V2")


def vehicles_that_showed(offset_a: float, sd_a: float) -> list[VehicleSummary]:
    """Two vehicles; the first battery sensor showed this offset with open contactors."""
    none = np.full(2, np.nan)
    shown = ZeroCurrent(offset_a=np.array([offset_a, np.nan]), sd_a=np.array([sd_a, np.nan]))
    delays = BranchDelays(branches=BRANCHES, delay_s=np.zeros(2), sd_s=np.zeros(2), known=np.ones(2, bool))
    return [
        VehicleSummary(
            vehicle=name, drives=("d",), summary=summary, delays=delays, zero_current=window, recorded=frozenset()
        )
        for name, summary, window in zip(
            ("V1", "V2"), summaries_of(no_faults(2, 2)), (shown, ZeroCurrent(offset_a=none, sd_a=none)), strict=True
        )
    ]


def bench_file(folder: Path, line: str) -> Path:
    path = folder / "bench.csv"
    path.write_text(f"vehicle,branch,drift,drift_sd,offset_a,offset_sd_a\n{line}\n")
    return path


@pytest.mark.parametrize("line", ["V1,motor,0.05,0.002,,", "V1,motor,,,3,0.2"])
def test_a_trusted_vehicle_that_was_read_as_faulty_is_refused(tmp_path: Path, line: str) -> None:
    path = bench_file(tmp_path, line)
    trusting = CalibrationSettings(trusted=frozenset({"V1"}), readings=path)
    with pytest.raises(FleetError, match=r"the motor sensor of V1 was read as faulty, and V1 is trusted"):
        read_bench(trusting, VEHICLES, BRANCHES, left_out={}, full_scale_a=400.0)
    others = CalibrationSettings(trusted=frozenset({"V2"}), readings=path)
    assert set(read_bench(others, VEHICLES, BRANCHES, left_out={}, full_scale_a=400.0)) == {("V1", "motor")}


def test_a_trusted_vehicle_may_be_read_as_faultless(tmp_path: Path) -> None:
    settings = CalibrationSettings(
        trusted=frozenset({"V1"}), readings=bench_file(tmp_path, "V1,motor,0.001,0.002,0.1,0.2")
    )
    assert len(read_bench(settings, VEHICLES, BRANCHES, left_out={}, full_scale_a=400.0)) == 1


def test_no_table_is_no_reading() -> None:
    assert read_bench(CalibrationSettings(), VEHICLES, BRANCHES, left_out={}, full_scale_a=400.0) == {}


def test_a_window_and_a_reading_that_agree_count_together() -> None:
    bench = {("V1", "battery"): (np.nan, np.nan, 5.1, 0.1), ("V2", "motor"): (0.02, 0.001, np.nan, np.nan)}
    readings, notices = merge_readings(vehicles_that_showed(4.9, 0.1), bench, BRANCHES)
    assert notices == []
    assert readings.offset_a[0, 0] == pytest.approx(5.0)
    assert readings.offset_sd_a[0, 0] == pytest.approx(0.1 / np.sqrt(2.0))
    assert readings.drift[1, 1] == pytest.approx(0.02)


def test_of_a_window_and_a_reading_that_contradict_each_other_neither_is_used() -> None:
    bench = {("V1", "battery"): (0.03, 0.001, -5.0, 0.1), ("gone", "motor"): (0.02, 0.001, np.nan, np.nan)}
    readings, notices = merge_readings(vehicles_that_showed(5.0, 0.1), bench, BRANCHES)
    assert np.isnan(readings.offset_a[0, 0])
    assert np.isnan(readings.offset_sd_a[0, 0])
    assert readings.drift[0, 0] == pytest.approx(0.03)
    assert notices[0].startswith("vehicle V1: its battery sensor was read as -5.0 A on the bench, and showed +5.0 A")
    assert notices[1] == "bench readings of vehicles that are left out are not used: gone"
