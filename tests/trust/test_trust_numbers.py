"""Numbers of statements: whatever number was accepted, a set can be taken back."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.canonical import canonical_bytes
from ecu_node.trust.state import TrustState, read_state
from ecu_node.trust.statements import LAST_SEQUENCE, MAX_SEQUENCE
from tests.trust.signing import Run, Signers

DAY = timedelta(days=1)


class Vehicle:
    """A vehicle with number 5 in force, and what is signed for it."""

    def __init__(
        self, folder: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
    ) -> None:
        self.folder, self.signers, self.database = folder, signers, database
        self._parameters = parameters

    def take(self, content: bytes) -> TrustState:
        return accept(self.folder, content, "f", self.database, datetime.now(UTC)).state

    def parameters(self, number: int) -> TrustState:
        return self.take(self.signers.parameters(self._parameters, number, not_before=datetime.now(UTC) - DAY))

    def tried(self, number: int) -> None:
        self.parameters(number)
        conclude(self.folder, number, passed=True, text="seen", now=datetime.now(UTC))

    def revoke(self, number: int, *revokes: int) -> TrustState:
        return self.take(self.signers.revocation(number, *revokes))


@pytest.fixture
def vehicle(in_force: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase) -> Vehicle:
    return Vehicle(in_force, signers, parameters, database)


@pytest.mark.parametrize("number", [MAX_SEQUENCE + 1, LAST_SEQUENCE])
def test_a_number_after_which_nothing_could_come_is_refused(number: int, vehicle: Vehicle) -> None:
    before = read_state(vehicle.folder)
    words = f"f: number {number}, and the highest is {MAX_SEQUENCE}, as nothing could come after it"
    for take in (vehicle.parameters, lambda number: vehicle.revoke(number, 5)):
        with pytest.raises(TrustError, match=words) as caught:
            take(number)
        assert caught.value.reason is Reason.REPLAYED
    assert read_state(vehicle.folder) == before


def test_the_set_with_the_highest_number_and_the_one_before_it_can_be_revoked(vehicle: Vehicle) -> None:
    vehicle.tried(MAX_SEQUENCE)
    with pytest.raises(TrustError, match="only revocations can be signed for it any more"):
        vehicle.parameters(MAX_SEQUENCE)
    assert vehicle.revoke(LAST_SEQUENCE, MAX_SEQUENCE).in_force == "a"
    assert vehicle.revoke(LAST_SEQUENCE, 5).in_force is None
    assert read_state(vehicle.folder).revoked == [5, MAX_SEQUENCE]


def test_a_vehicle_does_not_begin_with_a_key_set_after_which_none_could_come(
    signers: Signers, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "keys.json").write_bytes(canonical_bytes(signers.keys(version=1_000_000)) + b"\n")
    code, out, err = run(
        "provision", "--vehicle", "v1", "--keys", tmp_path / "keys.json", "--state", tmp_path / "state"
    )
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert "key set 1000000: the first one of a vehicle is at most 500000" in err
    assert not (tmp_path / "state").exists()
