"""The fuzz test of the node at small size, and that it would see what it looks for."""

from pathlib import Path
from random import Random

import pytest

from bench import node_fuzz, update_fuzz
from bench.node_fuzz import WrongFrameError
from bench.update_fuzz import Vehicle, WrongAnswerError
from ecu_node.core.corrector import Source
from ecu_node.core.status import Reason, TrustError


def test_random_frames_are_right_in_both_modes() -> None:
    assert list(node_fuzz.fuzz(1_500, seed=2, frames_per_vehicle=500))[-1] == 1_500


@pytest.mark.long
def test_frames_of_many_random_vehicles_are_right_in_both_modes() -> None:
    assert list(node_fuzz.fuzz(40_000, seed=1, frames_per_vehicle=1_000))[-1] == 40_000


@pytest.mark.parametrize(("mode", "method"), [("overlay", "answer"), ("gateway", "forward")])
def test_a_wrong_bit_is_reported_with_its_frame(monkeypatch: pytest.MonkeyPatch, mode: str, method: str) -> None:
    right = getattr(Source, method)

    def damaged(source: Source, payload: bytearray, now_s: float) -> object:
        made = right(source, payload, now_s)
        for item in [made] if isinstance(made, bytearray) else [target.data for target in made or ()]:
            item[0] ^= 1
        return made

    monkeypatch.setattr(Source, method, damaged)
    with pytest.raises(WrongFrameError, match=rf"seed 0, vehicle of frame 0, {mode}, frame \d+: .* -> .*#.*: "):
        list(node_fuzz.fuzz(500, seed=0))


def test_changed_bundles_are_refused_each_in_one_line(tmp_path: Path) -> None:
    assert update_fuzz.fuzz(range(500), tmp_path, seed=1) == 500


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Vehicle:
    return Vehicle(tmp_path_factory.mktemp("fuzz"))


def test_fuzzed_bundles_reach_every_check(vehicle: Vehicle) -> None:
    rng, said = Random(3), []
    for _ in range(300):
        content = vehicle.changed(rng)
        try:
            vehicle.update(content)
        except TrustError as error:
            said.append(str(error))
    for words in ("not a whole bundle", "was signed by", "older than", "is not in the bundle", "Failed to deserialize"):
        assert any(words in text for text in said), words


def test_bundle_that_is_accepted_is_reported(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not vehicle.require_refused(vehicle.bundles[1], "here")
    monkeypatch.setattr(Vehicle, "_is_same", lambda *_: False)
    with pytest.raises(WrongAnswerError, match=r"^here: accepted \(on trial: "):
        vehicle.require_refused(vehicle.bundles[1], "here")


@pytest.mark.parametrize(
    ("error", "words"),
    [(KeyError("slots"), r"here: KeyError\('slots'\)"), (TrustError(Reason.NONE, "two\nlines"), "here: not one line")],
)
def test_wrong_answer_is_named(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch, error: Exception, words: str) -> None:
    def failing(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(update_fuzz, "update", failing)
    with pytest.raises(WrongAnswerError, match=words):
        vehicle.require_refused(b"{}", "here")
