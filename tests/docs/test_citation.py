"""The citation says of the project what its metadata say."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_citation_has_title_and_licence_of_the_project_and_no_version_of_its_own() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = (ROOT / "CITATION.cff").read_text().splitlines()
    assert f"title: {project['name']}" in lines
    assert f"license: {project['license']}" in lines
    assert [line for line in lines if line.startswith("version:")] == []
