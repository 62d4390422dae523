from pathlib import Path

import pytest

from calibrator.errors import FleetError
from calibrator.results import read_results, read_run


def test_a_folder_that_is_no_result_is_named(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"run\.json: not a result of 'calibrator calibrate': No such file"):
        read_run(tmp_path)
    with pytest.raises(FleetError, match=r"results\.parquet: not a result of 'calibrator calibrate'"):
        read_results(tmp_path)


def test_a_damaged_run_is_named(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"tool": 1}')
    with pytest.raises(FleetError, match=r"run\.json: not a run of 'calibrator calibrate': .*; calibrate again"):
        read_run(tmp_path)
