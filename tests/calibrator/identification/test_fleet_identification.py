import pytest

from calibrator.artificial.dynamic_vehicles import PERIOD_S, dynamic_vehicle, recorded
from calibrator.drives.align import Samples
from calibrator.identification.fleet_identification import OWN_GAIN_DB, own_model
from calibrator.identification.pooled_bank import pooled_bank
from calibrator.identification.read_out import ReadOuts, far_below_fleet, fit_read_outs
from calibrator.summaries.summariser import summarise


@pytest.fixture(scope="module")
def fleet() -> list[Samples]:
    """Ten vehicles: the last but one has other poles, the last one noisy sensors."""
    alike = [recorded(j, snr_db=30.0).samples for j in range(8)]
    other_poles = recorded(8, snr_db=30.0, model=dynamic_vehicle(8, pole_scale=2.0)).samples
    return [*alike, other_poles, recorded(9, snr_db=10.0).samples]


@pytest.fixture(scope="module")
def read_outs(fleet: list[Samples]) -> ReadOuts:
    bank = pooled_bank([[drive] for drive in fleet[:6]], period_s=PERIOD_S)
    return fit_read_outs([summarise([drive], period_s=PERIOD_S, bank=bank) for drive in fleet])


def test_vehicles_that_are_simulated_worse_than_the_fleet_are_looked_at(read_outs: ReadOuts) -> None:
    assert far_below_fleet(read_outs).tolist() == [False] * 8 + [True, True]


def test_a_vehicle_of_clearly_different_poles_gets_a_model_of_its_own(
    fleet: list[Samples], read_outs: ReadOuts
) -> None:
    shared_db = read_outs.snr_db[8]
    own = own_model([fleet[8]], shared_db, period_s=PERIOD_S, vehicle="different")
    assert own is not None
    assert own.snr_db.min() > shared_db.min() + OWN_GAIN_DB
    assert own.snr_db.min() > 20.0


@pytest.mark.parametrize("alike", [0, 9])
def test_a_vehicle_that_shares_the_poles_gets_none_noisy_or_not(
    alike: int, fleet: list[Samples], read_outs: ReadOuts
) -> None:
    assert own_model([fleet[alike]], read_outs.snr_db[alike], period_s=PERIOD_S, vehicle="alike") is None
