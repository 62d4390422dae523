"""Values of derived inputs: formulas of the layout evaluated on arrays."""

import ast
from collections.abc import Callable, Mapping

import numpy as np

from calibrator.drive import Array
from ecu_node.formula import FUNCTIONS

__all__ = ["evaluate_formula"]

_OPERATIONS: dict[type[ast.operator], Callable[[Array, Array], Array]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
_FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "positive": lambda x: np.maximum(x, 0.0),
    "negative": lambda x: np.minimum(x, 0.0),
    "abs": np.abs,
    "sqrt": np.sqrt,
}
assert set(_FUNCTIONS) == set(FUNCTIONS)


def evaluate_formula(tree: ast.expr, values: Mapping[str, Array]) -> Array:
    """Evaluate a formula at each sample.

    Parameters
    ----------
    tree : ast.expr
        From :func:`ecu_node.formula.parse_formula`.
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
        case ast.Constant(value=int() | float() as number):
            return np.asarray(number, np.float64)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, values)
        case ast.UnaryOp(operand=operand):
            return _value(operand, values)
        case ast.BinOp(left=left, op=operation, right=right):
            return _OPERATIONS[type(operation)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _FUNCTIONS[name](_value(argument, values))
        case _:
            raise AssertionError(f"parse_formula lets no {ast.dump(node)} through")
