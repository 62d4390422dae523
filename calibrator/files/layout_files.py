"""Read the layout and DBC that the command line names, and check the layout's formulas."""

from pathlib import Path

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import LayoutError
from ecu_node.formulas import formula_names, parse_formula
from ecu_node.layout import Layout, read_layout

__all__ = ["check_formulas", "checked_layout", "vehicle_database"]


def checked_layout(path: Path) -> Layout:
    """Read a layout, and check its formulas as well; raise LayoutError if it cannot be used."""
    layout = read_layout(path)
    check_formulas(layout)
    return layout


def check_formulas(layout: Layout) -> None:
    """Raise LayoutError if a formula of a layout cannot be evaluated.

    Raises
    ------
    LayoutError
        If a formula is not arithmetic, or uses a name that is neither an input nor a derived input above it. In a
        layout without a DBC, the formula of a branch may also name columns.
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


def vehicle_database(layout: Path) -> VehicleDatabase:
    """Read a layout (TOML) with its DBC; LayoutError or DatabaseError if one of them cannot be used."""
    return read_database(checked_layout(layout))
