from dataclasses import replace

import numpy as np
import pytest

from calibrator.artificial.dynamic_vehicles import (
    INPUT_NAMES,
    PERIOD_S,
    drive_inputs,
    dynamic_vehicle,
    recorded,
)
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.identification.pooled_bank import pooled_bank
from calibrator.identification.read_out import (
    FIRST_HELD_OUT,
    FOLDS,
    far_below_fleet,
    fit_read_outs,
    state_space_model,
)
from calibrator.identification.state_space import StateSpaceModel, simulation_snr_db
from calibrator.summaries.filter_bank import FilterBank, low_pass_bank, plain_bank
from calibrator.summaries.moments import BLOCK_S, DriveSummary
from calibrator.summaries.summariser import summarise

BLOCK = round(BLOCK_S / PERIOD_S)
LEAD_IN = 600
PLAIN = plain_bank(INPUT_NAMES, period_s=PERIOD_S)
FILTERED = low_pass_bank(INPUT_NAMES, (0.5, 3.0), period_s=PERIOD_S)


def bank_of(model: StateSpaceModel) -> FilterBank:
    """The bank that has exactly the poles of a vehicle."""
    poles = np.linalg.eigvals(model.A)
    kept = tuple((float(pole.real), float(pole.imag)) for pole in poles if pole.imag >= 0.0)
    return FilterBank(input_names=INPUT_NAMES, period_s=PERIOD_S, poles=kept)


def summary_of(drive: Samples, bank: FilterBank = FILTERED) -> DriveSummary:
    return summarise([drive], period_s=PERIOD_S, bank=bank)


def by_samples(drive: Samples, bank: FilterBank = FILTERED) -> tuple[Array, Array, Array]:
    """Columns with the constant, currents, and the number of the block, of the blocks that are in the summary."""
    columns, used = bank.run(drive.inputs, drive.valid, bank.start())
    block = np.arange(len(used)) // BLOCK
    kept = np.unique(block[used], return_counts=True)
    good = kept[0][kept[1] >= 0.2 * BLOCK]
    used &= np.isin(block, good)
    number = np.searchsorted(good, block[used]).astype(float)
    return np.column_stack([columns[used], np.ones(int(used.sum()))]), drive.currents_a[used], number


def slopes_and_worst_db(model: StateSpaceModel, truth: StateSpaceModel) -> tuple[Array, float]:
    """Of the simulation on a common unity drive over the true currents."""
    unity = drive_inputs(999)
    true, simulated = (each.simulate(unity)[LEAD_IN:] for each in (truth, model))
    centred = true - true.mean(axis=0)
    slopes = np.sum(centred * simulated, axis=0) / np.sum(centred**2, axis=0)
    return slopes, float(simulation_snr_db(true, simulated).min())


def test_a_vehicle_whose_poles_the_bank_has_is_found() -> None:
    vehicle = recorded(1, snr_db=200.0)
    bank = bank_of(vehicle.model)
    model = state_space_model(bank, fit_read_outs([summary_of(vehicle.samples, bank)]), 0)
    unity = drive_inputs(999)
    # The states of the bank start at rest, and 5 % of that error is left when samples are used.
    expected, found = (each.simulate(unity)[LEAD_IN:] for each in (vehicle.model, model))
    assert simulation_snr_db(expected, found).min() > 50.0


def test_read_outs_are_the_least_squares_of_the_samples() -> None:
    drive = recorded(2, snr_db=20.0, samples=4000).samples
    found = fit_read_outs([summary_of(drive)])
    z, y, _ = by_samples(drive)
    expected = np.linalg.lstsq(z, y, rcond=None)[0]
    np.testing.assert_allclose(found.coefficients[0], expected[:-1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.offset_a[0], expected[-1], rtol=1e-6, atol=1e-6)
    left = y - z @ expected
    np.testing.assert_allclose(found.residual_a2[0], left.T @ left / len(left), rtol=1e-6, atol=1e-9)


def test_held_out_blocks_are_judged_as_from_their_samples() -> None:
    drive = recorded(3, snr_db=20.0, samples=4500).samples
    found = fit_read_outs([summary_of(drive)])
    z, y, block = by_samples(drive)
    held_out = block % FOLDS == FIRST_HELD_OUT
    fit = np.linalg.lstsq(z[~held_out], y[~held_out], rcond=None)[0]
    np.testing.assert_allclose(found.snr_db[0], simulation_snr_db(y[held_out], z[held_out] @ fit), atol=1e-6)


def test_vehicles_together_are_as_each_alone() -> None:
    summaries = [summary_of(recorded(j, snr_db=20.0, samples=3000 + 500 * j).samples) for j in range(4)]
    together = fit_read_outs(summaries)
    for j, summary in enumerate(summaries):
        alone = fit_read_outs([summary])
        np.testing.assert_allclose(together.coefficients[j], alone.coefficients[0], rtol=1e-9)
        np.testing.assert_allclose(together.snr_db[j], alone.snr_db[0], rtol=1e-9)


def test_units_and_zeros_of_inputs_and_currents_do_not_matter() -> None:
    drive = recorded(4, snr_db=20.0, samples=3000).samples
    changed = replace(drive, inputs=1e3 * drive.inputs - 50.0, currents_a=1e-2 * drive.currents_a + 3.0)
    plain, scaled = (state_space_model(FILTERED, fit_read_outs([summary_of(each)]), 0) for each in (drive, changed))
    unity = drive_inputs(999, samples=500)
    np.testing.assert_allclose(
        scaled.simulate(1e3 * unity - 50.0), 1e-2 * plain.simulate(unity) + 3.0, rtol=1e-6, atol=1e-7
    )
    np.testing.assert_allclose(scaled.snr_db, plain.snr_db, atol=1e-6)


def test_inputs_and_currents_that_stand_still_get_zeros_and_no_figure() -> None:
    drive = recorded(5, snr_db=20.0, samples=3000).samples
    inputs, currents = drive.inputs.copy(), drive.currents_a.copy()
    inputs[:, 1], currents[:, 2] = 7.0, -4.0
    found = fit_read_outs([summary_of(replace(drive, inputs=inputs, currents_a=currents))])
    np.testing.assert_array_equal(found.coefficients[0, 1::3], 0.0)
    np.testing.assert_allclose(found.coefficients[0, :, 2], 0.0, atol=1e-9)
    assert found.offset_a[0, 2] == pytest.approx(-4.0, abs=1e-6)
    assert np.isnan(found.snr_db[0, 2])
    assert np.isfinite(np.delete(found.snr_db[0], 2)).all()


def test_two_blocks_are_fitted_and_not_judged() -> None:
    found = fit_read_outs([summary_of(recorded(6, snr_db=20.0, samples=2 * BLOCK).samples, PLAIN)])
    assert np.isfinite(found.coefficients).all()
    assert np.isnan(found.snr_db).all()
    assert not far_below_fleet(found).any()


def test_summaries_of_different_banks_are_refused() -> None:
    drive = recorded(7, snr_db=20.0, samples=3000).samples
    with pytest.raises(DriveError, match="made with 2 filter banks"):
        fit_read_outs([summary_of(drive, bank) for bank in (PLAIN, FILTERED)])
    with pytest.raises(DriveError, match=r"do not fit the bank .*; summarise the drives with this bank"):
        state_space_model(PLAIN, fit_read_outs([summary_of(drive)]), 0)


@pytest.mark.parametrize(
    ("snr_db", "median_db", "worst_db", "slope"),
    [(20.0, 40.0, 38.0, 3e-3), (30.0, 48.0, 44.0, 1e-3), (40.0, 54.0, 45.0, 5e-4)],
)
def test_vehicles_whose_poles_differ_are_followed_by_the_bank_of_others(
    snr_db: float, median_db: float, worst_db: float, slope: float
) -> None:
    bank = pooled_bank([[recorded(j, snr_db=snr_db).samples] for j in range(100, 108)], period_s=PERIOD_S)
    vehicles = [recorded(j, snr_db=snr_db) for j in range(10)]
    read_outs = fit_read_outs([summary_of(vehicle.samples, bank) for vehicle in vehicles])
    found = [
        slopes_and_worst_db(state_space_model(bank, read_outs, j), vehicle.model) for j, vehicle in enumerate(vehicles)
    ]
    errors_db = [worst for _, worst in found]
    assert np.percentile(np.abs(np.concatenate([slopes for slopes, _ in found]) - 1.0), 95) < slope
    assert np.median(errors_db) > median_db
    assert min(errors_db) > worst_db
    assert not far_below_fleet(read_outs).any()


@pytest.mark.parametrize("snr_db", [30.0, 40.0])
def test_a_vehicle_of_other_dynamics_is_noticed_and_no_other(snr_db: float) -> None:
    bank = bank_of(dynamic_vehicle(0, pole_spread=0.0))
    models = [dynamic_vehicle(j, pole_spread=0.02) for j in range(5)] + [dynamic_vehicle(5, pole_scale=2.5)]
    drives = [recorded(j, snr_db=snr_db, model=model).samples for j, model in enumerate(models)]
    read_outs = fit_read_outs([summary_of(drive, bank) for drive in drives])
    assert far_below_fleet(read_outs).tolist() == [False] * 5 + [True]
