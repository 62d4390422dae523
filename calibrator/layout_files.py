"""Layout and DBC of one vehicle, as the command line names them."""

from pathlib import Path

import msgspec

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import DatabaseError
from ecu_node.layout import read_layout

__all__ = ["vehicle_database"]


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
    settings = read_layout(layout)
    if dbc is not None:
        if not dbc.is_file():
            raise DatabaseError(f"{dbc}: no such DBC; check --dbc")
        settings = msgspec.structs.replace(settings, dbc=str(dbc.absolute()))
    return read_database(settings)
