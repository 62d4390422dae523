"""Parameter files to export, and the command line."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from calibrator.cli import app
from calibrator.export.core import Checked, read_checked
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters, write_parameters
from tests.ecu_node.vehicles import LAYOUT

__all__ = ["checked_with", "export", "needs", "refused"]


def needs(*programs: str) -> pytest.MarkDecorator:
    """Skip where a program is not installed."""
    missing = [name for name in programs if shutil.which(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{', '.join(programs)} needed")


def checked_with(database: VehicleDatabase, parameters: VehicleParameters, folder: Path) -> Checked:
    """Parameters written to a file and read as the export reads them."""
    write_parameters(parameters, folder / "v1.json")
    return read_checked(folder / "v1.json", database, None)


def export(*arguments: object, layout: Path = LAYOUT) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments), "--layout", str(layout)])


def refused(*arguments: object, layout: Path = LAYOUT) -> UserError:
    error = export(*arguments, layout=layout).exception
    assert isinstance(error, UserError)
    assert "\n" not in str(error)
    return error
