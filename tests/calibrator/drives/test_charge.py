import numpy as np

from calibrator.drive import Array, Channel, Mask
from calibrator.drives.charge import Band, ChargeCurve, charge_curve

BAND = Band(short_s=0.2, long_s=2.0)


def curve_of(time_s: Array, value: Array, *, good: Mask | None = None) -> ChargeCurve:
    kept = np.ones(len(time_s), np.bool_) if good is None else good
    curve = charge_curve(Channel(time_s=time_s, value=value, good=kept))
    assert curve is not None
    return curve


def uneven(seed: int, duration_s: float = 20.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    time_s = np.sort(rng.uniform(0.0, duration_s, int(20 * duration_s)))
    return time_s, rng.normal(0.0, 30.0, len(time_s))


def test_slope_is_the_derivative_of_the_band() -> None:
    curve = curve_of(*uneven(2))
    instants_s, h = np.linspace(3.0, 17.0, 50), 1e-4
    _, slope = curve.band(instants_s, BAND)
    difference = (curve.band(instants_s + h, BAND)[0] - curve.band(instants_s - h, BAND)[0]) / (2.0 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-3, atol=0.05)


def test_instants_near_a_gap_or_an_end_are_not_covered() -> None:
    time_s = np.concatenate([np.arange(0.0, 5.0, 0.1), np.arange(7.0, 12.0, 0.1)])
    curve = curve_of(time_s, np.zeros(len(time_s)))
    instants_s = np.array([0.5, 1.5, 3.8, 4.5, 6.0, 7.5, 8.5, 10.5, 11.5])
    assert curve.covers(instants_s, 1.0).tolist() == [False, True, True, False, False, False, True, True, False]


def test_one_or_two_lost_frames_are_bridged_and_bad_samples_make_gaps() -> None:
    time_s = np.arange(0.0, 10.0, 0.1)
    for lost, bridged in ((1, True), (2, True), (3, False)):
        good = np.ones(100, np.bool_)
        good[50 : 50 + lost] = False
        curve = curve_of(time_s, np.where(good, 1.0, np.nan), good=good)
        assert curve.covers(np.array([5.0]), 1.0).tolist() == [bridged]


def test_band_of_a_straight_line_is_zero_even_after_hours() -> None:
    time_s, _ = uneven(3)
    time_s = time_s + 36_000.0
    x, slope = curve_of(time_s, 200.0 + 3.0 * (time_s - 36_000.0)).band(36_000.0 + np.linspace(3.0, 17.0, 50), BAND)
    np.testing.assert_allclose(x, 0.0, atol=1e-6)
    np.testing.assert_allclose(slope, 0.0, atol=1e-6)


def test_last_of_several_samples_at_one_instant_counts() -> None:
    time_s, value = np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.0, 9.0, 1.0, 2.0])
    curve = curve_of(time_s, value)
    assert curve.time_s.tolist() == [0.0, 1.0, 2.0]
    assert curve.pieces[2, :2].tolist() == [0.0, 1.0]
