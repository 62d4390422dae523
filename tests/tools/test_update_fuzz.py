"""The fuzz test of bundles at small size, and that it would see what it looks for."""

from pathlib import Path
from random import Random

import pytest

from bench import update_fuzz
from bench.update_fuzz import Vehicle, WrongAnswerError, fuzz
from ecu_node.core.status import Reason, TrustError


def test_changed_bundles_are_refused_each_in_one_line(tmp_path: Path) -> None:
    assert fuzz(range(500), tmp_path, seed=1) == 500


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
def test_crash_and_answer_of_two_lines_are_reported(
    vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(update_fuzz, "update", failing)
    with pytest.raises(WrongAnswerError, match=words):
        vehicle.require_refused(b"{}", "here")
