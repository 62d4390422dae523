import numpy as np
import pytest

from calibrator.drives.derived import evaluate_formula
from ecu_node.formula import parse_formula

VALUES = {"a": np.array([1.0, -2.0, 4.0]), "b": np.array([2.0, 0.0, -1.0])}


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("a * b", [2.0, -0.0, -4.0]),
        ("a + 2 * b - 1", [4.0, -3.0, 1.0]),
        ("-(a ** 2)", [-1.0, -4.0, -16.0]),
        ("+a", [1.0, -2.0, 4.0]),
        ("positive(a)", [1.0, 0.0, 4.0]),
        ("negative(a)", [0.0, -2.0, 0.0]),
        ("abs(a)", [1.0, 2.0, 4.0]),
        ("sqrt(abs(a))", [1.0, 2**0.5, 2.0]),
        ("3", [3.0, 3.0, 3.0]),
    ],
)
def test_a_formula_is_evaluated_at_each_sample(formula: str, expected: list[float]) -> None:
    np.testing.assert_allclose(evaluate_formula(parse_formula(formula), VALUES), expected)


@pytest.mark.parametrize("formula", ["a / b", "sqrt(a)", "a ** 0.5", "sqrt(b - 1)", "1e200 * 1e200 * b"])
def test_where_a_formula_has_no_value_the_result_is_not_finite_and_nothing_is_printed(formula: str) -> None:
    result = evaluate_formula(parse_formula(formula), VALUES)
    assert np.isfinite(result[0]) == (formula != "1e200 * 1e200 * b")
    assert not np.isfinite(result[1])


def test_a_missing_value_stays_missing() -> None:
    values = {"a": np.array([np.nan, 1.0])}
    for formula in ("a + 1", "positive(a)", "negative(a)", "a * 0"):
        assert np.isnan(evaluate_formula(parse_formula(formula), values)).tolist() == [True, False]
