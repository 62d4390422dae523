"""Parameter files to export, and the command line."""

import shutil
import subprocess
from pathlib import Path

import pytest

from calibrator.export.core import Checked, read_checked
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, write_parameters
from tests.calibrator import command_here
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


def export(*arguments: object, layout: Path = LAYOUT) -> "subprocess.CompletedProcess[str]":
    return command_here.calibrator("export", *arguments, "--layout", layout)


def refused(*arguments: object, layout: Path = LAYOUT) -> str:
    return command_here.refused("export", *arguments, "--layout", layout)
