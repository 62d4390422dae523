"""What the published method says of a fleet whose mean is hardly a reference."""

import json
from pathlib import Path

import pytest

from tests.calibrator.command_here import calibrator

LAYOUT = Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml"
FILES = ("--layout", LAYOUT, "--workers", 1)


@pytest.fixture(scope="module")
def small_fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("small") / "fleet"
    calibrator(
        "simulate", "--vehicles", 3, "--minutes", 2.2, "--unseen-minutes", 0.1, "--common-drive", *FILES, "--out", out
    )
    return out


@pytest.mark.parametrize(("options", "notices"), [([], 1), (["--symmetric"], 0)])
def test_small_fleet_is_noticed_on_the_screen_and_in_the_record(
    small_fleet: Path, options: list[str], notices: int, tmp_path: Path
) -> None:
    method = ["--method", "published", "--classifier", "threshold", *options]
    run = calibrator("calibrate", small_fleet, *method, "--out", tmp_path / "result", *FILES)
    record = json.loads((tmp_path / "result" / "run.json").read_text())
    told = [notice for notice in record["notices"] if notice.startswith("3 vehicles are few")]
    assert len(told) == notices
    assert all(f"notice: {notice}" in run.stdout for notice in told)
