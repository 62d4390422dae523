from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.estimator.evidence import stack_summaries
from calibrator.summaries.filter_bank import FilterBank, low_passes
from calibrator.summaries.moments import BLOCK_S, DriveSummary
from calibrator.summaries.summariser import Summariser, summarise_samples
from tests.calibrator.estimator.simulated_drives import PERIOD_S, Conditions, drive_of, no_faults, samples_of


def a_drive(seed: int, samples: int = 300, noise_a: float = 0.3) -> Samples:
    conditions = Conditions(samples=samples, noise_a=noise_a)
    return drive_of(np.random.default_rng(seed), no_faults(1, 3).take(0), conditions)


def a_bank(*time_constants_s: float) -> FilterBank:
    poles = low_passes(np.array(time_constants_s), period_s=PERIOD_S)
    return FilterBank(input_names=a_drive(0).input_names, period_s=PERIOD_S, poles=poles)


def assert_same(first: DriveSummary, second: DriveSummary) -> None:
    np.testing.assert_allclose(first.moments, second.moments, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(first.noise_a2, second.noise_a2, rtol=1e-12)
    assert (first.branches, first.period_s, first.bank) == (second.branches, second.period_s, second.bank)
    assert first.fit is not None
    assert second.fit is not None
    for name in ("levels", "fast_a2", "spikes", "temperature_c", "starts"):
        np.testing.assert_allclose(getattr(first.fit, name), getattr(second.fit, name), rtol=1e-9, atol=1e-7)


def test_moments_are_those_of_the_samples() -> None:
    drive = a_drive(1)
    summary = summarise_samples([drive], period_s=PERIOD_S)
    columns = np.column_stack([drive.inputs, drive.currents_a, np.ones(300)])
    np.testing.assert_allclose(summary.total, columns.T @ columns)
    np.testing.assert_allclose(summary.mean_a, drive.currents_a.mean(axis=0))
    np.testing.assert_allclose(summary.mean_product_a2, drive.currents_a.T @ drive.currents_a / 300)
    assert summary.moments.shape[0] == 300 * PERIOD_S / BLOCK_S
    assert summary.duration_s == 300.0


def test_summaries_of_drives_add_up() -> None:
    first, second = a_drive(2), a_drive(3)
    both = summarise_samples([first, second], period_s=PERIOD_S)
    alone = [summarise_samples([drive], period_s=PERIOD_S).total for drive in (first, second)]
    np.testing.assert_allclose(both.total, sum(alone))


def test_the_sum_of_summaries_is_the_summary_of_the_drives_together() -> None:
    first, second = a_drive(2), a_drive(3, samples=170)
    warm_c = [20.0 + 0.01 * drive.time_s for drive in (first, second)]
    together = summarise_samples([first, second], period_s=PERIOD_S, bank=a_bank(3.0, 8.0), temperatures_c=warm_c)
    alone = [
        summarise_samples([drive], period_s=PERIOD_S, bank=a_bank(3.0, 8.0), temperatures_c=[warm])
        for drive, warm in zip((first, second), warm_c, strict=True)
    ]
    assert_same(alone[0] + alone[1], together)


def test_what_was_summarised_differently_does_not_add_up() -> None:
    drive = a_drive(2)
    plain, filtered = (summarise_samples([drive], period_s=PERIOD_S, bank=bank) for bank in (None, a_bank(3.0)))
    with pytest.raises(DriveError, match=r"made with 2 filter banks \(.*\); expected one"):
        plain + filtered
    with pytest.raises(DriveError, match=r"3 and 2 branches .* do not add up"):
        plain + plain.take_branches([0, 1])


def test_a_fleet_of_different_banks_is_refused() -> None:
    summaries = [summarise_samples([a_drive(j)], period_s=PERIOD_S, bank=a_bank(3.0 + j)) for j in range(2)]
    with pytest.raises(DriveError, match="summaries of 2 drives or vehicles made with 2 filter banks"):
        stack_summaries(summaries)


def test_a_bank_of_other_inputs_or_of_another_period_is_refused() -> None:
    drive, bank = a_drive(2), a_bank(3.0)
    with pytest.raises(DriveError, match="align the drive with the bank's inputs"):
        summarise_samples([drive.with_inputs(drive.input_names[1:])], period_s=PERIOD_S, bank=bank)
    with pytest.raises(DriveError, match=r"every 0\.5 s, a filter bank of .* every 1 s"):
        summarise_samples([drive], period_s=0.5, bank=bank)


@pytest.mark.parametrize("time_constants_s", [(), (2.0, 9.0)])
def test_moments_of_a_bank_are_those_of_its_columns(time_constants_s: tuple[float, ...]) -> None:
    drive, bank = a_drive(8, samples=3000), a_bank(*time_constants_s)
    filtered, used = bank.run(drive.inputs, drive.valid, bank.start())
    columns = np.column_stack([filtered, drive.currents_a, np.ones(3000)])[used]
    kept = (used.reshape(-1, 30).sum(axis=1) >= 6).repeat(30)[used]
    np.testing.assert_allclose(
        summarise_samples([drive], period_s=PERIOD_S, bank=bank).total, columns[kept].T @ columns[kept], rtol=1e-10
    )


@settings(derandomize=True, deadline=None, max_examples=30)
@given(cuts=st.lists(st.integers(0, 1700), max_size=8), seed=st.integers(0, 100))
def test_pieces_of_a_drive_give_the_blocks_of_the_whole(cuts: list[int], seed: int) -> None:
    drive, rng = a_drive(seed, samples=1700), np.random.default_rng(seed)
    valid = (rng.random(1700) > 0.03) & (np.arange(1700) // 200 != seed % 8)
    gaps = replace(drive, valid=valid, currents_a=np.where(valid[:, None], drive.currents_a, np.nan))
    whole = summarise_samples([gaps, drive], period_s=PERIOD_S, bank=a_bank(2.0, 9.0))
    summariser = Summariser(a_bank(2.0, 9.0), branches=3)
    edges = [0, *sorted(cuts), 1700]
    for samples in (gaps, drive):
        for a, b in pairwise(edges):
            summariser.add(samples.inputs[a:b], samples.currents_a[a:b], samples.valid[a:b])
        summariser.end_drive()
    assert_same(summariser.summary(), whole)


def test_a_drive_can_come_sample_by_sample() -> None:
    drive = a_drive(9, samples=1700)
    summariser = Summariser(a_bank(2.0), branches=3)
    for t in range(1700):
        summariser.add(drive.inputs[t : t + 1], drive.currents_a[t : t + 1], drive.valid[t : t + 1])
    summariser.end_drive()
    assert_same(summariser.summary(), summarise_samples([drive], period_s=PERIOD_S, bank=a_bank(2.0)))


def test_a_piece_that_does_not_fit_is_refused() -> None:
    drive = a_drive(9)
    with pytest.raises(DriveError, match=r"of shapes \(300, 3\), \(300, 2\), .*; expected \(300, 3\), \(300, 3\)"):
        Summariser(a_bank(2.0), branches=3).add(drive.inputs, drive.currents_a[:, 1:], drive.valid)


def test_a_drive_shorter_than_its_bank_settles_is_refused_with_the_reason() -> None:
    with pytest.raises(DriveError, match="once its filter bank has settled, 300 s after a start"):
        summarise_samples([a_drive(7, samples=200)], period_s=PERIOD_S, bank=a_bank(100.0))


def test_samples_that_are_not_valid_take_no_part() -> None:
    drive = a_drive(4)
    valid, currents = drive.valid.copy(), drive.currents_a.copy()
    valid[5:20], currents[5:20] = False, np.nan
    summary = summarise_samples([replace(drive, valid=valid, currents_a=currents)], period_s=PERIOD_S)
    np.testing.assert_allclose(summary.mean_a, drive.currents_a[valid].mean(axis=0))
    assert np.isfinite(summary.moments).all()


def test_branches_can_be_taken_in_another_order() -> None:
    drive = a_drive(5)
    order = [2, 0, 1]
    taken = summarise_samples([drive], period_s=PERIOD_S).take_branches(order)
    direct = summarise_samples([replace(drive, currents_a=drive.currents_a[:, order])], period_s=PERIOD_S)
    np.testing.assert_allclose(taken.moments, direct.moments)
    np.testing.assert_allclose(taken.noise_a2, direct.noise_a2)


@pytest.mark.parametrize("samples", [30, 300])
def test_white_noise_is_measured_without_bias(samples: int) -> None:
    rng = np.random.default_rng(6)
    variance = [
        summarise_samples(
            [samples_of(np.zeros((samples, 0)), rng.normal(0.0, 2.0, (samples, 2)))], period_s=PERIOD_S
        ).noise_a2
        for _ in range(400)
    ]
    assert np.mean(np.concatenate(variance)) == pytest.approx(4.0, rel=0.03)


def test_slow_currents_are_not_taken_for_noise() -> None:
    t = np.arange(600.0)
    currents = np.column_stack([100.0 * np.sin(t / 30.0), np.zeros(600)])
    assert summarise_samples([samples_of(np.zeros((600, 0)), currents)], period_s=PERIOD_S).noise_a2.max() < 1e-3


def test_a_drive_without_enough_valid_samples_is_refused() -> None:
    drive = a_drive(7, samples=60)
    with pytest.raises(DriveError, match="no 30 s of drive in which 20% of the samples are valid"):
        summarise_samples([replace(drive, valid=np.zeros(60, bool))], period_s=PERIOD_S)
