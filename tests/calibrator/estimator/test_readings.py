"""Direct readings: mistakes in a table and contradictions are reported, and contradictions are not averaged."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.estimator import readings
from calibrator.estimator.evidence import EvidenceRows
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent
from ecu_node.layout import UnmeasuredLoad

VEHICLES, BRANCHES, FULL_SCALE_A = ("V1", "V2"), ("battery", "motor"), 400.0
HEADER = "vehicle,branch,drift,drift_sd,offset_a,offset_sd_a"
NAN = np.nan


def read(folder: Path, *lines: str, trusted: tuple[str, ...] = ()) -> readings.BenchTable:
    path = folder / "bench.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    problems = {"V1": "", "V2": "", "copy": "same recording as V1"}
    return readings.read_bench_table(path, BRANCHES, problems, trusted=trusted, full_scale_a=FULL_SCALE_A)


def bench_of(drift: float, drift_sd: float, offset_a: float, offset_sd_a: float, *sensor: str) -> readings.BenchTable:
    vehicle, branch = sensor or ("V1", "battery")
    return {(vehicle, branch): readings.BenchReading(drift, drift_sd, offset_a, offset_sd_a)}


def rows_of(relative: float = 0.0, constant_a: tuple[float, ...] = (0.0,)) -> EvidenceRows:
    """Vehicles of three branches; the second gain ratio of the first is off, and junction constants are."""
    N, K = len(constant_a), 3
    covariance = np.tile(1e-6 * np.eye(5 * K), (N, 1, 1))
    rows = EvidenceRows(values=np.zeros((N, 5 * K)), covariance=covariance, means=np.zeros((N, 2, K)))
    rows.relative[0, K + 1] = relative
    rows.constant[:, K] = np.array(constant_a) / FULL_SCALE_A
    return rows


def test_table_of_readings_may_have_any_column_order_and_empty_cells(tmp_path: Path) -> None:
    bench = read(tmp_path, HEADER, "V2, motor, 0.02, 0.001, , ", "", "V1,battery,,,-1.5,0.2")
    (drift, offset_a), (drift_sd, offset_sd_a) = readings.bench_readings(bench, VEHICLES, BRANCHES)
    np.testing.assert_array_equal(drift, [[NAN, NAN], [NAN, 0.02]])
    np.testing.assert_array_equal(drift_sd, [[NAN, NAN], [NAN, 0.001]])
    np.testing.assert_array_equal(offset_a, [[-1.5, NAN], [NAN, NAN]])
    np.testing.assert_array_equal(offset_sd_a, [[0.2, NAN], [NAN, NAN]])
    other = read(tmp_path, 'branch , vehicle,offset_sd_a,"offset_a"', 'motor,"V1",0.1,3')
    assert other["V1", "motor"][2:4] == (3.0, 0.1)


@pytest.mark.parametrize(("lines", "message"), [
    (["vehicle;branch;drift"], r"bench.csv: columns vehicle;branch;drift; expected each of vehicle, branch, drift"),
    (["vehicle,branch,drift,drift_sd,drift,drift_sd"], r"bench.csv: columns .*; expected each of .* once"),
    ([HEADER], r"no reading below the header; leave --readings out"),
    ([HEADER, "V3,motor,0,0.1,,"], r"line 2: no vehicle 'V3' in this fleet; there are, for example, V1, V2"),
    ([HEADER, "copy,motor,0.2,0.1,,"], r"line 2: vehicle 'copy' is left out: same recording as V1"),
    ([HEADER, "V1,engine,0,0.1,,"], r"line 2: no branch 'engine' in this fleet; known are battery, motor"),
    ([HEADER, "V1,motor,2 %,0.1,,"], r"line 2: drift is '2 %'; expected a number"),
    ([HEADER, "V1,motor,0.02,,,"], r"line 2: drift_sd is ''; expected a number from 1e-05 to 0\.9: its"),
    ([HEADER, "V1,motor,,,1.0,0"], r"line 2: offset_sd_a is '0'; expected a number from 0\.004 to 360: .* in A"),
    ([HEADER, "V1,motor,2,0.1,,"], r"line 2: drift is '2'; expected a number from -0\.9 to 0\.9: .*2 % is 0\.02"),
    ([HEADER, "V1,motor,0,0.1,,", "V1,motor,0,0.1,,"], r"line 3: the motor sensor of V1 stands there twice"),
    ([HEADER, "V1,motor,,,,"], r"line 2: nothing was read; give drift and drift_sd, or offset_a and offset_sd_a"),
    ([HEADER, 'V1,"' + 200_000 * "x"], r"not a table of bench readings: field larger than field limit"),
    ([HEADER, "V1,motor,0,0.1,,,,7"], r"line 2: more cells than the 6 columns of the header"),
])  # fmt: skip
def test_mistake_in_a_table_of_readings_is_refused_and_named(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(FleetError, match=message):
        read(tmp_path, *lines)


@pytest.mark.parametrize("reading", ["0.05,0.002,,", ",,3.0,0.2"])
def test_trusted_vehicle_with_a_faulty_bench_reading_is_refused(tmp_path: Path, reading: str) -> None:
    line = f"V1,battery,{reading}"
    with pytest.raises(FleetError, match=r"line 2: the battery sensor of V1 was read as faulty, and V1 is trusted"):
        read(tmp_path, HEADER, line, trusted=("V1",))
    read(tmp_path, HEADER, line, trusted=("V2",))
    read(tmp_path, HEADER, "V1,battery,0.001,0.002,0.1,0.2", trusted=("V1",))


def test_bench_and_window_readings_are_averaged_or_both_dropped_if_contradictory() -> None:
    shown = {"V1": (4.9, 0.1), "V2": (5.0, 0.1), "V3": (NAN, NAN)}  # by the battery sensor with open contactors
    windows = (ZeroCurrent(offset_a=np.array([o, NAN]), sd_a=np.array([sd, NAN])) for o, sd in shown.values())
    summaries = [SimpleNamespace(vehicle=name, zero_current=each) for name, each in zip(shown, windows, strict=True)]
    vehicles = cast("list[VehicleSummary]", summaries)
    bench = {
        **bench_of(NAN, NAN, 5.1, 0.1),
        **bench_of(0.03, 0.001, -5.0, 0.1, "V2", "battery"),
        **bench_of(0.02, 0.001, NAN, NAN, "V3", "motor"),
        **bench_of(0.02, 0.001, NAN, NAN, "gone", "motor"),
    }
    merged, notices = readings.merge_readings(vehicles, bench, BRANCHES)
    assert merged[:, 1, 0, 0] == pytest.approx([5.0, 0.1 / np.sqrt(2.0)])
    assert np.isnan(merged[:, 1, 1, 0]).all()
    assert (merged[0, 0, 1, 0], merged[0, 0, 2, 1]) == pytest.approx((0.03, 0.02))
    assert notices[0].startswith("vehicle V2: its battery sensor was read as -5.0 A on the bench, and showed +5.0 A")
    assert notices[1] == "bench readings of vehicles that are left out are not used: gone"


def with_windows(*shown_a: tuple[float, float]) -> list[VehicleSummary]:
    windows = (ZeroCurrent(offset_a=np.array(pair), sd_a=np.array([0.03, 0.03])) for pair in shown_a)
    summaries = [SimpleNamespace(vehicle=f"V{j + 1}", zero_current=each) for j, each in enumerate(windows)]
    return cast("list[VehicleSummary]", summaries)


def test_window_in_which_a_current_flows_between_two_sensors_is_not_used() -> None:
    vehicles = with_windows((0.84, -0.85), (0.84, 0.85), (0.2, -0.2), (5.0, -4.5), (NAN, NAN))
    assert readings.current_flows(vehicles).tolist() == [True, False, False, False, False]
    assert np.isnan(readings.window_readings(vehicles)[0, 1]).all(axis=1).tolist() == [True, False, False, False, True]
    causes = [[each.cause for each in readings.flow_findings(vehicle)] for vehicle in vehicles]
    assert causes == [["window"], [], [], [], []]
    (finding,) = readings.flow_findings(vehicles[0])
    assert finding.text.startswith("two sensors show the same current with opposite signs while")


@pytest.mark.parametrize(("shown_a", "flows"), [
    ([(0.25, -0.2), (0.2, -0.22), (0.22, -0.2), (9.0, -0.2)], True),
    ([(0.25, -0.2), (0.2, -0.22), (9.0, -0.2), (0.2, 0.2)], False),
    ([(0.1, -0.1)] * 4, False),
    ([(0.5, -0.5)] * 2, False),
])  # fmt: skip
def test_windows_are_not_used_if_the_same_current_flows_in_most(
    shown_a: list[tuple[float, float]], flows: bool
) -> None:
    vehicles = with_windows(*shown_a)
    assert readings.flows_in_fleet(vehicles) == flows
    assert np.isnan(readings.merge_readings(vehicles, {}, BRANCHES, windows=False)[0]).all()


@pytest.mark.parametrize("others_a", [0.0, 5.0, -12.0])
def test_trusted_vehicle_violating_the_junction_law_is_found(others_a: float) -> None:
    names = (*BRANCHES, "auxiliary")
    rows = rows_of(0.05, (0.0, 0.0, 3.0, -9.0, others_a))
    found = readings.untrusted_vehicles(rows, np.arange(5) < 4, names, full_scale_a=FULL_SCALE_A)
    assert list(found) == [0, 3]
    assert re.match(r"the gains of its sensors auxiliary and battery differ by \+5\.0%", found[0])
    assert found[3] == "its currents sum to -9.0 A on average, which no load without a sensor explains"
    load = UnmeasuredLoad(mean_a=3.0, sd_a=0.1)
    declared = readings.untrusted_vehicles(rows, np.arange(5) < 3, names, full_scale_a=FULL_SCALE_A, load=load)
    assert list(declared) == [0, 1]
    assert "which the declared load of 3 A does not explain" in declared[1]
