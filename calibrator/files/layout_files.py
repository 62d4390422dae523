"""Layout and DBC of one vehicle, as the command line names them."""

from pathlib import Path

import msgspec

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.formulas import formula_names, parse_formula
from ecu_node.layout import Layout, read_layout

__all__ = ["check_formulas", "chosen_layout", "vehicle_database"]


def chosen_layout(layout: Path, dbc: Path | None = None) -> Layout:
    """Read a layout, its formulas too, and let it name another DBC if one is given; see :func:`vehicle_database`."""
    settings = read_layout(layout)
    check_formulas(settings)
    if dbc is None:
        return settings
    if not dbc.is_file():
        raise DatabaseError(f"{dbc}: no such DBC; check --dbc")
    if len(settings.bus) > 1:
        raise LayoutError(f"{layout}: names several buses with a DBC each; leave --dbc out")
    buses = [msgspec.structs.replace(bus, dbc=str(dbc.absolute())) for bus in settings.bus]
    changed: Layout = msgspec.structs.replace(settings, dbc=None if buses else str(dbc.absolute()), bus=buses)
    return changed


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


def vehicle_database(layout: Path, dbc: Path | None = None) -> VehicleDatabase:
    """Read a layout with its DBC, or with another one.

    Parameters
    ----------
    layout : Path
        Layout (TOML).
    dbc : Path or None
        DBC to use instead of the one that the layout names.

    Returns
    -------
    VehicleDatabase
        DBC and layout.

    Raises
    ------
    LayoutError, DatabaseError
        If one of them cannot be used.
    """
    return read_database(chosen_layout(layout, dbc))
