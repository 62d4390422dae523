"""Formulas of the layout, such as ``torque * speed / voltage``: parsed, checked and evaluated on arrays.

Allowed are names, numbers, ``+ - * /``, ``**`` with a number, parentheses, and positive(x) = max(x, 0),
negative(x) = min(x, 0), abs(x), and sqrt(x) of x >= 0. The text is never given to ``eval``.
"""

import ast
from collections.abc import Callable, Mapping

import numpy as np

from calibrator.drive import Array
from ecu_node.errors import LayoutError
from ecu_node.layout import Layout

__all__ = ["check_formulas", "evaluate_formula", "formula_names", "parse_formula"]

_OPERATIONS: dict[type[ast.operator], Callable[[Array, Array], Array]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}
_FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "positive": lambda x: np.maximum(x, 0.0),
    "negative": lambda x: np.minimum(x, 0.0),
    "abs": np.abs,
    "sqrt": np.sqrt,
}


def check_formulas(layout: Layout) -> None:
    """Check the formulas of a layout.

    Raises
    ------
    LayoutError
        If one is not arithmetic, or names what is neither an input nor a derived input above it; of a layout without
        a DBC a branch may name columns, too.
    """
    known = {item.name for item in layout.input}
    formulas = [(f"derived input {item.name}", item.formula, item.name) for item in layout.derived]
    formulas += [(f"branch {item.name}", item.formula, "") for item in layout.branch if item.formula is not None]
    for where, formula, derived in formulas:
        try:
            unknown = [name for name in formula_names(parse_formula(formula)) if name not in known]
        except LayoutError as error:
            raise LayoutError(f"{layout.path}: {where}: {error}") from None
        if unknown and (derived or layout.dbc_files):
            names = ", ".join(unknown)
            raise LayoutError(
                f"{layout.path}: {where}: {names} is no [[input]] or [[derived]] above it; declare it as one"
            )
        known.add(derived)


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
        evaluate_formula(tree, {name: np.ones(1) for name in formula_names(tree)})  # which refuses all else
    except LayoutError as error:
        raise LayoutError(f"formula {text!r}: {error}") from None
    except (SyntaxError, ValueError, OverflowError, MemoryError):
        raise LayoutError(f"formula {text!r} is not arithmetic; write it like 'torque * speed / voltage'") from None
    except RecursionError:
        raise LayoutError(f"formula {text[:40]!r}... is nested too deeply") from None
    return tree


def formula_names(tree: ast.expr) -> list[str]:
    """Names of the inputs that a formula uses, sorted."""
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return sorted({node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in called})


def evaluate_formula(tree: ast.expr, values: Mapping[str, Array]) -> Array:
    """Evaluate a formula at each sample.

    Parameters
    ----------
    tree : ast.expr
        From :func:`parse_formula`.
    values : mapping of str to ndarray of shape (T,)
        Inputs by name; all that the formula names.

    Returns
    -------
    ndarray of shape (T,)
        Values; NaN or infinite where the formula has none (division by zero, root of a negative number, overflow).
    """
    shape = np.broadcast_shapes(*(value.shape for value in values.values()))
    with np.errstate(all="ignore"):
        return np.array(np.broadcast_to(_value(tree, values), shape), np.float64)


def _value(node: ast.expr, values: Mapping[str, Array]) -> Array:
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return np.asarray(number, np.float64)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            return _value(operand, values) * (-1.0 if isinstance(sign, ast.USub) else 1.0)
        case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=int() | float() as exponent)):
            return np.power(_value(base, values), float(exponent))
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in _OPERATIONS:
            return _OPERATIONS[type(operation)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](_value(argument, values))
    raise LayoutError(
        f"{ast.unparse(node)!r} is not allowed; use names, numbers, + - * / ** and {', '.join(_FUNCTIONS)}"
    )
