"""Bench readings as a table: every slip is named with its line."""

from pathlib import Path

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.evidence.readings_file import read_bench_readings, readings_of

VEHICLES, BRANCHES = ("V1", "V2"), ("battery", "motor")
HEADER = "vehicle,branch,drift,drift_sd,offset_a,offset_sd_a"


def write(folder: Path, *lines: str) -> Path:
    path = folder / "bench.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_readings_come_as_arrays_and_empty_cells_as_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, HEADER, "V2, motor, 0.02, 0.001, , ", "V1,battery,,,-1.5,0.2")
    readings = readings_of(read_bench_readings(path, VEHICLES, BRANCHES), VEHICLES, BRANCHES)
    nan = np.nan
    np.testing.assert_array_equal(readings.drift, [[nan, nan], [nan, 0.02]])
    np.testing.assert_array_equal(readings.drift_sd, [[nan, nan], [nan, 0.001]])
    np.testing.assert_array_equal(readings.offset_a, [[-1.5, nan], [nan, nan]])
    np.testing.assert_array_equal(readings.offset_sd_a, [[0.2, nan], [nan, nan]])


def test_one_pair_of_columns_is_enough_in_any_order_and_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text("branch,vehicle,offset_sd_a,offset_a\nmotor,V1,0.1,3\n", encoding="utf-8-sig")
    found = read_bench_readings(path, VEHICLES, BRANCHES)
    assert found["V1", "motor"][2:] == (3.0, 0.1)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["vehicle;branch;drift"], r"line 1: columns vehicle;branch;drift; expected vehicle, branch, drift"),
        (["vehicle,branch"], r"line 1: columns vehicle, branch; expected"),
        (["vehicle,branch,drift,drift_sd,colour"], r"line 1: columns .*colour; expected"),
        ([], r"line 1: columns none; expected"),
        ([HEADER, "V3,motor,0,0.1,,"], r"line 2: no vehicle 'V3' in this fleet; known are V1, V2"),
        ([HEADER, "V1,engine,0,0.1,,"], r"line 2: no branch 'engine' in this fleet; known are battery, motor"),
        ([HEADER, "V1,motor,2 %,0.1,,"], r"line 2: drift is '2 %'; expected a number"),
        ([HEADER, "V1,motor,nan,0.1,,"], r"line 2: drift is 'nan'; expected a number"),
        ([HEADER, "V1,motor,0.02,,,"], r"line 2: drift_sd is ''; expected a number, and drift together with drift_sd"),
        ([HEADER, "V1,motor,,,1.0,0"], r"line 2: offset_sd_a is 0; expected the positive standard deviation"),
        ([HEADER, "V1,motor,-1,0.1,,"], r"line 2: drift -1; expected a relative gain error above -1"),
        ([HEADER, "V1,motor,,,,"], r"line 2: nothing was read"),
        ([HEADER, "V1,motor,0,0.1,,", "V1,motor,0,0.1,,"], r"line 3: the motor sensor of V1 stands there twice"),
        ([HEADER, "V1,motor,0,0.1,,,,7"], r"line 2: more cells than the 6 columns"),
        ([HEADER, "V1"], r"line 2: no branch '' in this fleet"),
    ],
)
def test_a_slip_is_named_with_its_line(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(FleetError, match=message):
        read_bench_readings(write(tmp_path, *lines), VEHICLES, BRANCHES)


def test_a_table_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"none\.csv: cannot read the bench readings: No such file"):
        read_bench_readings(tmp_path / "none.csv", VEHICLES, BRANCHES)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FleetError, match=r"not UTF-8 text"):
        read_bench_readings(binary, VEHICLES, BRANCHES)
