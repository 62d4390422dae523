"""Bench readings as a table: every slip is named with its line."""

from pathlib import Path

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.posterior.bench_table import BenchReadings, read_bench_readings, readings_of

VEHICLES, BRANCHES = ("V1", "V2"), ("battery", "motor")
HEADER = "vehicle,branch,drift,drift_sd,offset_a,offset_sd_a"
LEFT_OUT = {"copy": "same recording as V1"}


def read(path: Path) -> BenchReadings:
    return read_bench_readings(path, VEHICLES, BRANCHES, left_out=LEFT_OUT, full_scale_a=400.0)


def write(folder: Path, *lines: str) -> Path:
    path = folder / "bench.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_readings_come_as_arrays_and_empty_cells_as_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, HEADER, "V2, motor, 0.02, 0.001, , ", "", "V1,battery,,,-1.5,0.2")
    readings = readings_of(read(path), VEHICLES, BRANCHES)
    nan = np.nan
    np.testing.assert_array_equal(readings.drift, [[nan, nan], [nan, 0.02]])
    np.testing.assert_array_equal(readings.drift_sd, [[nan, nan], [nan, 0.001]])
    np.testing.assert_array_equal(readings.offset_a, [[-1.5, nan], [nan, nan]])
    np.testing.assert_array_equal(readings.offset_sd_a, [[0.2, nan], [nan, nan]])


def test_one_pair_of_columns_is_enough_in_any_order_with_blanks_and_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text('branch , vehicle,offset_sd_a,"offset_a"\nmotor,"V1",0.1,3\n', encoding="utf-8-sig")
    assert read(path)["V1", "motor"][2:] == (3.0, 0.1)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["vehicle;branch;drift"], r"line 1: columns vehicle;branch;drift; expected each of vehicle, branch, drift"),
        (["vehicle,branch"], r"line 1: columns vehicle, branch; expected"),
        (["vehicle,branch,drift,drift_sd,colour"], r"line 1: columns .*colour; expected"),
        ([], r"line 1: columns none; expected"),
        ([HEADER, "V3,motor,0,0.1,,"], r"line 2: no vehicle 'V3' in this fleet; known are V1, V2"),
        ([HEADER, "V1,engine,0,0.1,,"], r"line 2: no branch 'engine' in this fleet; known are battery, motor"),
        ([HEADER, "V1,motor,2 %,0.1,,"], r"line 2: drift is '2 %'; expected a number"),
        ([HEADER, "V1,motor,nan,0.1,,"], r"line 2: drift is 'nan'; expected a number"),
        ([HEADER, "V1,motor,0.02,,,"], r"line 2: drift_sd is ''; expected a number, and drift together with drift_sd"),
        ([HEADER, "V1,motor,,,1.0,0"], r"line 2: offset_sd_a is 0; expected a number from 0\.004 to 180: in A"),
        ([HEADER, "V1,motor,,,1.0,1e-200"], r"line 2: offset_sd_a is 1e-200; expected a number from"),
        ([HEADER, "V1,motor,2,0.1,,"], r"line 2: drift is 2; expected a magnitude from 0 to 0\.45: .*2 % is 0\.02"),
        ([HEADER, "V1,motor,0.2,1,,"], r"line 2: drift_sd is 1; expected a number from 1e-05 to 0\.45"),
        ([HEADER, "copy,motor,0.2,0.1,,"], r"line 2: vehicle 'copy' is left out: same recording as V1"),
        ([HEADER], r"no reading below the header; leave --readings out"),
        (["vehicle,branch,drift,drift_sd,drift,drift_sd"], r"line 1: columns .*; expected each of .* once"),
        (["v" * 200_000], r"line \d: not a table of bench readings: field larger than"),
        ([HEADER, "V1,motor,,,,"], r"line 2: nothing was read"),
        ([HEADER, "V1,motor,0,0.1,,", "V1,motor,0,0.1,,"], r"line 3: the motor sensor of V1 stands there twice"),
        ([HEADER, "V1,motor,0,0.1,,,,7"], r"line 2: 8 cells, and the header has 6 columns"),
        ([HEADER, "V1"], r"line 2: no branch '' in this fleet"),
    ],
)
def test_a_slip_is_named_with_its_line(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(FleetError, match=message):
        read(write(tmp_path, *lines))


def test_a_table_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"none\.csv: cannot read the bench readings: No such file"):
        read(tmp_path / "none.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FleetError, match=r"not UTF-8 text"):
        read(binary)
