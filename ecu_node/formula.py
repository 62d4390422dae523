"""Formulas of derived inputs, such as ``torque * speed / voltage``.

Allowed: names, numbers, ``+ - * /``, ``**`` with a number, parentheses, and the functions of :data:`FUNCTIONS`.
The text is parsed here and never given to ``eval``.
"""

import ast

from ecu_node.errors import LayoutError

__all__ = ["FUNCTIONS", "formula_names", "parse_formula"]

FUNCTIONS = ("positive", "negative", "abs", "sqrt")
"""positive(x) = max(x, 0), negative(x) = min(x, 0), abs(x), sqrt(x) of x >= 0."""


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
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise LayoutError(f"formula {text!r} is not arithmetic; write it like 'torque * speed / voltage'") from None
    try:
        _require_arithmetic(tree, text)
    except RecursionError:
        raise LayoutError(f"formula {text[:40]!r}... is nested too deeply") from None
    return tree


def formula_names(tree: ast.expr) -> list[str]:
    """Names of the inputs that a formula uses, sorted."""
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return sorted({node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in called})


def _require_arithmetic(node: ast.expr, text: str) -> None:
    match node:
        case ast.Name():
            operands: list[ast.expr] = []
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            operands = []
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            operands = [operand]
        case ast.BinOp(op=ast.Pow(), left=base, right=ast.Constant(value=int() | float())):
            operands = [base]
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div(), right=right):
            operands = [left, right]
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
            operands = [argument]
        case _:
            raise LayoutError(
                f"formula {text!r}: {ast.unparse(node)!r} is not allowed; "
                f"use names, numbers, + - * / ** and {', '.join(FUNCTIONS)}"
            )
    for operand in operands:
        _require_arithmetic(operand, text)
