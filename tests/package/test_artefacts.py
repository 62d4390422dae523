"""What is in the wheel and in the source distribution, and what is not."""

import subprocess
import sys
import zipfile
from pathlib import Path

from tests.package.clean_venv import ROOT

LEFT_OUT = {"__pycache__", ".venv", "build", "dist", "api", "gallery", "sg_execution_times.rst"}
"""Generated folders and files, which are not part of the repository."""


def files(folder: Path) -> set[str]:
    """Files below a folder that are kept, relative to the root of the checkout."""
    kept = (path for path in folder.rglob("*") if path.is_file() and not LEFT_OUT & set(path.relative_to(ROOT).parts))
    return {str(path.relative_to(ROOT)) for path in kept}


def test_wheel_contains_the_files_of_the_packages_and_no_others(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        own = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert own == files(ROOT / "calibrator") | files(ROOT / "ecu_node")


def test_source_distribution_contains_every_tracked_file(unpacked: Path) -> None:
    folders = ("calibrator", "dbc", "deploy", "docs", "ecu_node", "examples", "tests", "tools", ".ci")
    kept = set().union(*(files(ROOT / folder) for folder in folders))
    kept |= {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile", "README.md"}
    kept |= {"constraints.txt", "pyproject.toml"}
    assert {name for name in kept if not (unpacked / name).is_file()} == set()


def test_tests_in_the_source_distribution_are_complete_and_run(unpacked: Path) -> None:
    def pytest_in(folder: Path, *options: str) -> str:
        command = [sys.executable, "-m", "pytest", "--quiet", "-p", "no:cacheprovider", *options]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, done.stdout
        return done.stdout.replace(str(folder), "")

    listed = (pytest_in(folder, "--collect-only").splitlines() for folder in (unpacked, ROOT))
    in_source, here = ({line for line in lines if "::" in line} for lines in listed)
    assert len(here) > 1000
    assert in_source == here
    some = ("tests/ecu_node/test_correction.py", "tests/deploy", "tests/docs/test_documents.py")
    assert " passed" in pytest_in(unpacked, *some)
