"""Licences of the dependencies: all of them are known, go with Apache-2.0, and stand in the document."""

import re
from importlib.metadata import Distribution, PathDistribution
from pathlib import Path

import pytest

from release.clean_venv import ROOT, pins
from release.licences import DOCUMENT, EXTRAS, Package, licence_of, packages, problems


@pytest.fixture(scope="module")
def found() -> list[Package]:
    return packages()


@pytest.fixture(scope="module")
def documented() -> dict[str, tuple[str, str]]:
    """Version and licence by package."""
    rows = re.findall(r"(?m)^\| ([a-z0-9-]+) \| (\S*\d\S*) \| (.+) \|$", DOCUMENT.read_text())
    return {name: (version, licence) for name, version, licence in rows}


def test_every_licence_goes_with_apache_2(found: list[Package]) -> None:
    assert problems(found) == []


def test_every_extra_needs_something(found: list[Package]) -> None:
    assert {package.extra for package in found} == set(EXTRAS)
    assert {"python-can", "numpy", "asammdf"} <= {package.name for package in found}


def test_the_document_has_every_package(found: list[Package], documented: dict[str, tuple[str, str]]) -> None:
    assert {package.name for package in found} - documented.keys() == set(), "run make licences"


def test_the_document_has_the_licences_that_are_installed(
    found: list[Package], documented: dict[str, tuple[str, str]]
) -> None:
    told = {p.name: documented[p.name] for p in found if p.version == documented[p.name][0]}
    assert told == {package.name: (package.version, package.licence) for package in found if package.name in told}
    assert len(told) > 0.9 * len(found)  # the others have another version for another Python


def test_the_document_is_of_the_pinned_versions(documented: dict[str, tuple[str, str]]) -> None:
    pinned = {line.partition(" ")[0] for line in pins((ROOT / "constraints.txt").read_text()).splitlines()}
    assert {f"{name}=={version}" for name, (version, _) in documented.items()} - pinned == set(), "run make licences"


def installed(folder: Path, *lines: str) -> Distribution:
    """A package with these lines among its metadata."""
    (folder / "METADATA").write_text("\n".join(["Metadata-Version: 2.4", "Name: some", "Version: 1.0", *lines]) + "\n")
    return PathDistribution(folder)


@pytest.mark.parametrize(
    ("line", "licence"),
    [
        ("License-Expression: GPL-3.0-or-later", "GPL-3.0-or-later"),
        ("License-Expression: MIT AND AGPL-3.0-only", "MIT AND AGPL-3.0-only"),
        ("License: GPLv3", "GPLv3"),
        ("Classifier: License :: OSI Approved :: GNU General Public License v2 (GPLv2)", None),
        ("Classifier: License :: Other/Proprietary License", None),
        ("License: UNKNOWN", "UNKNOWN"),
        ("Summary: nothing is said", "unknown"),
    ],
)
def test_gpl_and_unknown_licences_are_refused(tmp_path: Path, line: str, licence: str | None) -> None:
    told = licence_of(installed(tmp_path, line))
    assert licence in {None, told}
    (problem,) = problems([Package(name="some", version="1.0", licence=told, extra="")])
    assert problem.startswith("some 1.0: licence ")
    assert "choose another package" in problem


@pytest.mark.parametrize(
    ("lines", "licence"),
    [
        (["License-Expression: Apache-2.0 WITH LLVM-exception AND (MIT OR Zlib)"], None),
        (["License: LGPLv3+"], "LGPL-3.0-or-later"),
        (
            [
                "License: Copyright 2025 Somebody",
                " and a long text",
                "Classifier: License :: OSI Approved :: MIT License",
            ],
            "MIT",
        ),
        (["License: UNKNOWN", "Classifier: License :: OSI Approved :: ISC License (ISCL)"], "ISC"),
    ],
)
def test_permissive_and_library_licences_are_accepted(tmp_path: Path, lines: list[str], licence: str | None) -> None:
    told = licence_of(installed(tmp_path, *lines))
    assert licence in {None, told}
    assert problems([Package(name="some", version="1.0", licence=told, extra="")]) == []
