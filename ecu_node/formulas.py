"""Formulas of the layout, such as ``torque * speed / voltage``: parsed, checked, and evaluated on numbers or arrays.

Allowed are names, numbers, ``+ - * /``, ``**`` with a number, parentheses, and positive(x) = max(x, 0),
negative(x) = min(x, 0), abs(x), and sqrt(x) of x >= 0. The text is never given to ``eval``.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from ecu_node.errors import LayoutError

__all__ = ["FUNCTIONS", "formula_names", "formula_value", "parse_formula"]


def _quotient(x: float, y: float) -> float:
    return x / y if y else math.nan


def _power(x: float, y: float) -> float:
    try:
        return math.pow(x, y)
    except (ValueError, OverflowError):
        return math.nan


FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _quotient,
    "**": _power,
    "positive": lambda x: max(x, 0.0),
    "negative": lambda x: min(x, 0.0),
    "abs": abs,
    "sqrt": lambda x: math.sqrt(x) if x >= 0.0 else math.nan,
}
"""Operations and functions of formulas, for numbers; the result is NaN where there is no value."""
_SIGNS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}


@cache
def parse_formula(text: str) -> ast.expr:
    """Parse a formula and refuse everything that is not arithmetic.

    Parameters
    ----------
    text : str
        The formula as written in the layout.

    Returns
    -------
    ast.expr
        Syntax tree made only of names, numbers, the four operations, powers with a number, and known functions.

    Raises
    ------
    LayoutError
        If the text is no formula, or uses something else; the message says what.
    """
    try:
        tree = ast.parse(text, mode="eval").body
        formula_value(tree, dict.fromkeys(formula_names(tree), 1.0))  # raises if anything else is in it
    except LayoutError as error:
        raise LayoutError(f"formula {text!r}: {error}") from None
    except (SyntaxError, ValueError, OverflowError, MemoryError):
        raise LayoutError(f"formula {text!r} is not arithmetic; write it like 'torque * speed / voltage'") from None
    except RecursionError:
        raise LayoutError(f"formula {text[:40]!r}... is nested too deeply") from None
    return tree


@cache
def formula_names(tree: ast.expr) -> tuple[str, ...]:
    """Return the names of the inputs that a formula uses, sorted."""
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return tuple(sorted({node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in called}))


def formula_value(
    node: ast.expr, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]] = FUNCTIONS
) -> Any:
    """Evaluate a formula.

    Parameters
    ----------
    node : ast.expr
        Syntax tree of :func:`parse_formula`.
    values : mapping of str to float, or to arrays
        Values of all inputs that the formula names.
    functions : mapping of str to callable
        Operations and functions by the names in :data:`FUNCTIONS`; give others for arrays.

    Returns
    -------
    float or array
        The value; NaN or infinite where the formula has none (division by zero, root of a negative number, overflow).

    Raises
    ------
    LayoutError
        If the formula holds anything but names, numbers, and the operations and functions of this module.
    """
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            value = formula_value(operand, values, functions)
            return -value if isinstance(sign, ast.USub) else value
        case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=int() | float() as exponent)):
            return functions["**"](formula_value(base, values, functions), float(exponent))
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in _SIGNS:
            pair = (formula_value(side, values, functions) for side in (left, right))
            return functions[_SIGNS[type(operation)]](*pair)
        case ast.Call(func=ast.Name(id=name), args=[one], keywords=[]) if name.isidentifier() and name in functions:
            return functions[name](formula_value(one, values, functions))
    allowed = ", ".join(name for name in FUNCTIONS if name.isidentifier())
    raise LayoutError(f"{ast.unparse(node)!r} is not allowed; use names, numbers, + - * / ** and {allowed}")
