from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.summaries import filter_bank

PERIOD_S = 0.1
NAMES = ("driving", "heater", "speed")
POLES: filter_bank.Poles = ((0.9, 0.3), *filter_bank.low_passes(np.array([0.3, 4.0]), period_s=PERIOD_S), (0.5, 0.6))
SAMPLES = 700
HOLDING = round(filter_bank.LONGEST_HOLD_S / PERIOD_S)


def bank_of(poles: filter_bank.Poles = POLES) -> filter_bank.FilterBank:
    return filter_bank.FilterBank(input_names=NAMES, period_s=PERIOD_S, poles=poles)


def inputs_of(seed: int, samples: int = SAMPLES) -> Array:
    return np.random.default_rng(seed).normal(3.0, 2.0, (samples, len(NAMES)))


def test_columns_are_the_inputs_and_each_input_filtered_by_each_pole() -> None:
    u = inputs_of(0)
    columns, used = bank_of().run(u, np.ones(SAMPLES, bool))
    poles = [complex(*pole) for pole in (*POLES[1:3], POLES[0], POLES[3])]
    filtered = [lfilter([0.0, 1.0 - p], [1.0, -p], u, axis=0, zi=u[:1].astype(complex))[0] for p in poles]
    expected = np.hstack([u, *(x.real for x in filtered), *(x.imag for x in filtered[2:])])
    assert columns.shape[1] == bank_of().width
    np.testing.assert_allclose(columns[used], expected[used], atol=1e-12)
    np.testing.assert_array_equal(columns[~used], 0.0)


@pytest.mark.parametrize("is_long", [False, True])
def test_short_gap_holds_the_inputs_and_a_long_gap_restarts_the_filters(is_long: bool) -> None:
    u, valid = inputs_of(5), np.ones(SAMPLES, bool)
    gap = slice(300, 300 + HOLDING + is_long)
    held = u.copy()
    u[gap], held[gap], valid[gap] = np.nan, u[299], False
    columns, used = bank_of().run(u, valid)
    expected, settled = bank_of().run(held, np.ones(SAMPLES, bool))
    if is_long:
        expected[gap.stop :], settled[gap.stop :] = bank_of().run(u[gap.stop :], valid[gap.stop :])
    np.testing.assert_array_equal(used, settled & valid)
    np.testing.assert_array_equal(columns[used], expected[used])
    assert used[gap.stop :].any()


def test_bank_is_read_back_unchanged_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "bank.json").write_bytes(bank_of().to_json())
    assert filter_bank.read_bank(tmp_path / "bank.json") == bank_of()


@pytest.mark.parametrize(("text", "message"), [
    ("", "No such file or directory; give a file that 'calibrator identify' wrote"),
    ("{", "no filter bank"),
    ('{"input_names": ["u"], "period_s": 0.1, "gains": []}', "no filter bank .*gains"),
    ('{"input_names": ["u"], "period_s": 0.1, "poles": [[1.0, 0.0]]}', "pole 1 .* inside the unit circle"),
    ('{"input_names": ["u"], "period_s": 0.1, "poles": [[0.5, -0.1]]}', "positive imaginary part"),
    ('{"input_names": ["u"], "period_s": 0.0}', "period 0.0 s; expected a positive number"),
    ('{"input_names": ["u", "u"], "period_s": 0.1}', "expected distinct names"),
])  # fmt: skip
def test_file_that_is_not_a_filter_bank_is_refused_and_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bank.json"
    if text:
        path.write_text(text)
    with pytest.raises(DriveError, match=rf"bank\.json: .*{message}"):
        filter_bank.read_bank(path)


def test_poles_are_described_as_times_and_frequencies() -> None:
    poles = (*filter_bank.low_passes(np.array([2.0]), period_s=PERIOD_S), (0.9 * np.cos(0.5), 0.9 * np.sin(0.5)))
    assert bank_of(poles).described() == "2 s, 0.796 Hz (0.949 s)"
    assert bank_of(()).described() == "the plain inputs"
