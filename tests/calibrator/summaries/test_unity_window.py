from pathlib import Path

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.summaries.filter_bank import plain_bank
from calibrator.summaries.unity import UnityWindow, decode_window, liveliest_window
from tests.calibrator.conftest import run_command

WINDOW = UnityWindow(
    vehicle="v 1",
    drive="d",
    time_s=0.5 * np.arange(4),
    columns=np.array([[1.0, 2.0], [np.nan, np.nan], [3.0, 4.0], [5.0, 6.0]]),
    voltage_v=None,
    bank=plain_bank(("speed", "torque"), period_s=0.5),
)


def test_a_window_comes_back_as_it_was_written() -> None:
    found = decode_window(WINDOW.encoded(), "unity.parquet")
    np.testing.assert_array_equal(found.columns, WINDOW.columns)
    np.testing.assert_array_equal(found.time_s, WINDOW.time_s)
    assert (found.vehicle, found.drive, found.voltage_v, found.bank) == ("v 1", "d", None, WINDOW.bank)


@pytest.mark.parametrize("content", [b"", b"PAR1", WINDOW.encoded()[:-50]])
def test_a_damaged_window_is_named(content: bytes) -> None:
    with pytest.raises(FleetError, match=r"unity\.parquet: damaged unity window: .*; remove it"):
        decode_window(content, "unity.parquet")


def test_the_window_is_where_the_currents_vary_most() -> None:
    currents_a = np.random.default_rng(0).normal(0.0, 1.0, (500, 2))
    currents_a[300:350] *= 50.0
    start = liveliest_window(currents_a, np.ones(500, bool), 60)
    assert start is not None
    assert 290 <= start <= 300


def test_a_constant_current_is_not_lively_however_large() -> None:
    currents_a = np.full((500, 1), 300.0)
    currents_a[100:160, 0] = np.sin(np.arange(60))
    currents_a[:100], currents_a[160:] = 0.0, 0.0
    assert liveliest_window(currents_a, np.ones(500, bool), 60) == 100


def test_samples_that_are_not_valid_do_not_count() -> None:
    currents_a = np.random.default_rng(0).normal(0.0, 1.0, (500, 2))
    currents_a[300:350] = np.nan
    valid = np.asarray(np.isfinite(currents_a[:, 0]))
    start = liveliest_window(currents_a, valid, 60)
    assert start is not None
    assert valid[start : start + 60].mean() >= 0.95


@pytest.mark.parametrize("valid", [np.zeros(100, bool), np.arange(100) % 2 == 0, np.ones(50, bool)])
def test_without_a_valid_window_there_is_none(valid: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> None:
    assert liveliest_window(np.zeros((len(valid), 1)), valid, 60) is None


def test_summarising_a_fleet_keeps_a_window_and_calibrating_it_hands_it_on(tmp_path: Path) -> None:
    """The path of a user: logs, summaries, result."""
    layout = str(Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml")
    fleet, store, result = (str(tmp_path / name) for name in ("fleet", "store", "result"))
    simulate = ["simulate", "--layout", layout, "--out", fleet, "--vehicles", "6", "--minutes", "3"]
    assert run_command([*simulate, "--unseen-minutes", "1"]) == 0
    assert run_command(["summarise", fleet, "--layout", layout, "--out", store]) == 0
    kept = decode_window((Path(store) / "unity.parquet").read_bytes(), "kept")
    assert kept.columns.shape == (600, 12)
    assert np.isfinite(kept.columns).mean() >= 0.95
    assert kept.voltage_v is not None
    assert 300.0 < kept.voltage_v < 450.0
    assert run_command(["calibrate", store, "--layout", layout, "--out", result]) == 0
    assert (Path(result) / "unity.parquet").read_bytes() == (Path(store) / "unity.parquet").read_bytes()
    assert run_command(["report", result, "--out", str(tmp_path / "page.html")]) == 0
    page = tmp_path / "V001.html"
    assert run_command(["report", result, "--vehicle", "V001", "--out", str(page)]) == 0
    assert '"window":{"vehicle":"V001","seconds":60' in page.read_text()
