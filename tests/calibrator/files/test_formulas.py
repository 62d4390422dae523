"""Formulas of a layout: arithmetic is evaluated, everything else is refused with file and place."""

from pathlib import Path

import numpy as np
import pytest

from calibrator.drives.align import evaluate_formula
from calibrator.files.layout_files import checked_layout
from ecu_node.errors import LayoutError
from ecu_node.formulas import formula_value, parse_formula
from tests.ecu_node.vehicles import SMALL_LAYOUT

VALUES = {"a": np.array([1.0, -2.0, 4.0]), "b": np.array([2.0, 0.0, -1.0])}


@pytest.mark.parametrize(("formula", "expected"), [
    ("a * b", [2.0, -0.0, -4.0]), ("a + 2 * b - 1", [4.0, -3.0, 1.0]), ("-(a ** 2)", [-1.0, -4.0, -16.0]),
    ("+a", [1.0, -2.0, 4.0]), ("positive(a)", [1.0, 0.0, 4.0]), ("negative(a)", [0.0, -2.0, 0.0]),
    ("abs(a)", [1.0, 2.0, 4.0]), ("sqrt(abs(a))", [1.0, 2**0.5, 2.0]), ("3", [3.0, 3.0, 3.0]),
])  # fmt: skip
def test_formula_is_evaluated_at_each_sample(formula: str, expected: list[float]) -> None:
    np.testing.assert_allclose(evaluate_formula(formula, VALUES), expected)


@pytest.mark.parametrize("formula", ["a / b", "sqrt(a)", "a ** 0.5", "sqrt(b - 1)", "1e200 * 1e200 * b"])
def test_formula_gives_a_non_finite_value_without_warning_where_it_is_undefined(formula: str) -> None:
    result = evaluate_formula(formula, VALUES)
    assert np.isfinite(result[0]) == (formula != "1e200 * 1e200 * b")
    assert not np.isfinite(result[1])
    assert np.isnan(formula_value(parse_formula(formula), {name: float(value[1]) for name, value in VALUES.items()}))


@pytest.mark.parametrize(("formula", "words"), [
    ("speed * 2", r"speed is no \[\[input\]\]"), ("d + 1", r"d is no \[\[input\]\]"), ("open(1)", "not allowed"),
    ("a b", "not arithmetic"),
])  # fmt: skip
def test_layout_with_an_invalid_formula_is_refused(tmp_path: Path, formula: str, words: str) -> None:
    path = tmp_path / "small.toml"
    derived = f'derived = [{{ name = "d", formula = "{formula}" }}]\nfull_scale_a'
    path.write_text(SMALL_LAYOUT.replace("full_scale_a", derived))
    with pytest.raises(LayoutError, match=rf"small\.toml: derived input d: .*{words}") as caught:
        checked_layout(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["", "a b", "a; b", "a if b else c", "a.b", "a[0]", "f(a)", "sqrt(a, b)", "a ** b", "'x'", "True",
     "lambda: 1", "__import__('os')", "a < b", "a // b", "(" * 500 + "a" + ")" * 500, "-" * 5000 + "a", "\0",
     "a" + " + a" * 1500],
    ids=lambda text: text if 0 < len(text) < 40 else f"{len(text)} characters",
)  # fmt: skip
def test_formula_with_anything_but_arithmetic_is_refused(text: str) -> None:
    with pytest.raises(LayoutError, match="formula") as caught:
        parse_formula(text)
    assert "\n" not in str(caught.value)
