import math

import pytest

from calibrator.terminal.text import few_reasons, figure


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
    assert few_reasons({"V1": "cut"}) == "; V1: cut"
    assert few_reasons(dict(list(reasons.items())[:5])) == five
    assert few_reasons(reasons) == f"{five}; and 2 more"
    assert few_reasons(reasons, count=1000) == f"{five}; and 995 more"
