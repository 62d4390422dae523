"""The fuzz test of signed files at small size, and that it would see what it looks for."""

from pathlib import Path
from random import Random

import pytest

from bench import trust_fuzz
from bench.trust_fuzz import Vehicle, WrongAnswerError, fuzz
from bench.trust_fuzz_mutations import MUTATIONS
from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.trust.judgement import Arrival


def test_five_thousand_changed_files_are_refused_each_in_one_line() -> None:
    assert list(fuzz(5_000, seed=1))[-1] == 5_000


@pytest.fixture
def vehicle(tmp_path: Path) -> Vehicle:
    return Vehicle(tmp_path)


def test_the_same_seed_draws_the_same_files(vehicle: Vehicle) -> None:
    first, second = ([vehicle.changed(rng) for _ in range(200)] for rng in (Random("seed"), Random("seed")))
    assert first == second


def test_every_way_to_change_a_file_changes_it(vehicle: Vehicle) -> None:
    valid = vehicle.valid
    for mutation in MUTATIONS:
        rng = Random(1)
        changed = [mutation(rng, file, other) for file in valid for other in valid for _ in range(10)]
        assert sum(file not in valid for file in changed) > len(changed) / 2, mutation


def test_some_changed_files_come_as_far_as_the_signatures(vehicle: Vehicle) -> None:
    rng = Random(2)
    said = [vehicle.answer(vehicle.changed(rng))[1] for _ in range(500)]
    for words in ("the file was changed", "not trusted here", "signers are needed", "not canonical", "not base64"):
        assert any(words in text for text in said), words


def test_statements_that_are_signed_anew_come_as_far_as_every_check(vehicle: Vehicle) -> None:
    rng = Random(3)
    answers = [vehicle.answer(vehicle.signed_anew(rng)) for _ in range(2_000)]
    assert any(accepted for accepted, _ in answers)
    for words in (
        "signed content",
        "this is 'bench'",
        "was accepted before",
        "beyond the layout",
    ):
        assert any(words in text for accepted, text in answers if not accepted), words


def test_a_file_that_is_accepted_is_reported(vehicle: Vehicle) -> None:
    with pytest.raises(WrongAnswerError, match=r"^here: accepted: [A-Za-z0-9+/=]+$"):
        vehicle.require_refused(vehicle.valid[1], "here")


@pytest.mark.parametrize(
    ("error", "words"),
    [(KeyError("slots"), r"here: KeyError\('slots'\)"), (TrustError(Reason.NONE, "two\nlines"), "here: not one line")],
)
def test_a_crash_and_an_answer_of_two_lines_are_reported(
    vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    def failing(arrival: Arrival, database: VehicleDatabase) -> None:
        raise error

    monkeypatch.setattr(trust_fuzz, "judge_arrival", failing)
    with pytest.raises(WrongAnswerError, match=words):
        vehicle.require_refused(b"{}", "here")
