"""Databases for the tests of the export."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT


@pytest.fixture
def make_database(tmp_path: Path) -> Callable[..., VehicleDatabase]:
    """A database from the texts of layout and DBC."""

    def make(layout: str = SMALL_LAYOUT, dbc: str = SMALL_DBC) -> VehicleDatabase:
        (tmp_path / "small.toml").write_text(layout)
        (tmp_path / "small.dbc").write_text(dbc)
        return read_database(read_layout(tmp_path / "small.toml"))

    return make
