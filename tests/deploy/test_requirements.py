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


def test_every_pin_has_its_hashes() -> None:
    for file in ("requirements.txt", "requirements-build.txt"):
        blocks = re.split(r"\n(?=[a-z0-9])", (DEPLOY / file).read_text())[1:]
        assert all("--hash=sha256:" in block for block in blocks)


def test_the_container_checks_hashes_and_runs_without_privileges() -> None:
    lines = (DEPLOY / "Containerfile").read_text().splitlines()
    installs = [line for line in lines if "pip install" in line and "-r " in line]
    assert len(installs) == 2
    assert all("--require-hashes" in line for line in installs)
    assert "USER 65534:65534" in lines
    assert 'ENTRYPOINT ["/opt/ecu-node/bin/ecu-node"]' in lines
