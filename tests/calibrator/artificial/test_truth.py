from pathlib import Path

import msgspec
import pytest

from calibrator.errors import FleetError
from calibrator.fleet_truth import FleetTruth, VehicleTruth, read_truth, with_fleet_id, write_truth


def truth(drift: float = 0.1, seed: int = 0) -> FleetTruth:
    by_branch = {"battery": 0.0, "motor": 0.0}
    vehicle = VehicleTruth(
        hardware_drift=0.0,
        hardware_offset_a=by_branch,
        drift={"battery": drift, "motor": 0.0},
        offset_a=by_branch,
        delay_s=by_branch,
        unmeasured_a=0.0,
        unseen_mean_a=by_branch,
        unseen_mean_square_a2=by_branch,
    )
    return with_fleet_id(
        FleetTruth(
            fleet_id="",
            layout="l",
            branches=["battery", "motor"],
            full_scale_a=400.0,
            seed=seed,
            sparsity=80.0,
            magnitude=(0.05, 0.25),
            balanced=False,
            symmetric=False,
            common_drive=False,
            noise=0.001,
            vehicles={"V001": vehicle},
        )
    )


def test_other_faults_or_settings_make_another_fleet() -> None:
    assert len({each.fleet_id for each in (truth(), truth(drift=0.2), truth(seed=1))}) == 3


def test_what_is_written_is_read_and_a_truth_without_a_fleet_is_refused(tmp_path: Path) -> None:
    write_truth(tmp_path / "truth.json", truth())
    assert read_truth(tmp_path / "truth.json") == truth()
    content = msgspec.to_builtins(truth())
    del content["fleet_id"]
    (tmp_path / "truth.json").write_bytes(msgspec.json.encode(content))
    with pytest.raises(FleetError, match=r"truth\.json: not a truth\.json of 'calibrator simulate'.*fleet_id"):
        read_truth(tmp_path / "truth.json")
