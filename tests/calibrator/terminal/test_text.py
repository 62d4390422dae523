import math

import pytest

from calibrator.terminal.text import Notice, few_reasons, figure, left_out_text, merged_notices, reasons_text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (50.0, 1, "50"),
        (2.4, 3, "2.4"),
        (0.034567, 2, "0.035"),
        (4096.4, 2, "4,096"),
        (-123.456, 3, "-123"),
        (0.0, 3, "0"),
        (-1e-12, 3, "0"),
        (1e7, 3, "10,000,000"),
        (math.nan, 3, "-"),
    ],
)
def test_figures_are_written_as_people_do(value: float, digits: int, text: str) -> None:
    assert figure(value, digits) == text


def test_of_many_reasons_five_are_told_and_how_many_more_there_are() -> None:
    reasons = {f"V{j}": "cut" for j in range(7)}
    five = "; V0: cut; V1: cut; V2: cut; V3: cut; V4: cut"
    assert few_reasons({}) == ""
    assert few_reasons(dict(list(reasons.items())[:5])) == five
    assert few_reasons(reasons, count=1000) == f"{five}; and 995 more"


def test_one_reason_of_many_vehicles_is_one_line() -> None:
    reasons = dict.fromkeys((f"V{k:03}" for k in range(1, 45)), "too short")
    line = "V001, V002, V003, V004, V005, V006 and 38 more: too short"
    assert left_out_text(reasons) == f"left out:\n  {line}"
    assert reasons_text("cannot tell", reasons) == f"cannot tell:\n  {line}"
    assert left_out_text({}) == ""


@pytest.mark.parametrize(("drives", "text"), [
    (["V1/monday"], "V1/monday: 1 of 2 frames"),
    (["V1/monday", "V1/tuesday"], "in 2 drives of V1: 2 of 4 frames"),
    (["V1/monday", "V1/tuesday", "V2/monday"], "in 3 drives of 2 vehicles: 3 of 6 frames"),
    (["V1/monday", "V2/monday"], "in 2 vehicles: 2 of 4 frames"),
])  # fmt: skip
def test_equal_notices_are_told_once_with_the_sum_of_their_counts(drives: list[str], text: str) -> None:
    notice = Notice(text="{} of {} frames", counts=(1, 2))
    notices = {(vehicle, name): [notice] for vehicle, _, name in (each.partition("/") for each in drives)}
    assert merged_notices(notices) == [text]
