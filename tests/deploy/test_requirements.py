"""The pinned files of the vehicle's computer are in step with the constraints."""

import runpy
from pathlib import Path

DEPLOY = Path(__file__).parents[2] / "deploy"


def test_the_files_are_in_step_with_the_constraints() -> None:
    for path, text in runpy.run_path(str(DEPLOY / "requirements.py"))["files"]().items():
        assert path.read_text() == text, f"{path} is out of date: run deploy/requirements.py"
