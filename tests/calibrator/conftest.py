from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"


@pytest.fixture(scope="session")
def database() -> VehicleDatabase:
    return read_database(read_layout(LAYOUT))
