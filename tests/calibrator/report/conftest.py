from pathlib import Path

import pytest

from ecu_node.database import VehicleDatabase
from tests.calibrator.report.results_at_hand import six_vehicle_result


@pytest.fixture
def result(tmp_path: Path, database: VehicleDatabase) -> Path:
    """A result of the six vehicles of ``results_at_hand``."""
    return six_vehicle_result(tmp_path / "result", database)
