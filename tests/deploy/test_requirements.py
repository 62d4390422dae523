"""The pinned files of the vehicle's computer, and the container that is built with them."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"


@pytest.fixture(scope="module")
def requirements() -> ModuleType:
    spec = importlib.util.spec_from_file_location("deploy_requirements", DEPLOY / "requirements.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_files_are_in_step_with_the_constraints(requirements: ModuleType) -> None:
    for path, text in requirements.files().items():
        assert path.read_text() == text, f"{path} is out of date: run deploy/requirements.py"


def test_the_node_needs_few_packages_and_none_of_the_calibrator() -> None:
    names = set(re.findall(r"^([a-z0-9-]+)==", (DEPLOY / "requirements.txt").read_text(), re.MULTILINE))
    assert {"python-can", "cantools", "msgspec", "fastcrc", "autosar-e2e"} <= names
    assert not names & {"numpy", "scipy", "pandas", "rich", "hatchling", "asammdf"}
    assert len(names) < 20
