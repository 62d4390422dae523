"""Words and equations: each is defined once, and what the method says of a vehicle is what it can say."""

import re
from pathlib import Path
from typing import get_args

import pytest

from ecu_node.parameters import HeldBack, Verdict

ROOT = Path(__file__).parents[2]
METHOD = (ROOT / "docs" / "method.md").read_text()
NUMBER = re.compile(r"\(M(\d+)\)")


def terms(column: str) -> list[str]:
    """Entries of the first column of a table of the nomenclature."""
    lines = (ROOT / "docs" / "nomenclature.md").read_text().split(f"| {column} |")[1].splitlines()[2:]
    rows = [line.split("|")[1] for line in lines[: lines.index("")]] if "" in lines else []
    return [term.strip() for row in rows for term in row.split(",")]


@pytest.mark.parametrize(("column", "example"), [("word", "model spread"), ("symbol", "N")])
def test_each_word_and_symbol_is_defined_once(column: str, example: str) -> None:
    found = terms(column)
    assert example in found
    assert sorted({term for term in found if found.count(term) > 1}) == []


def tags() -> list[int]:
    """Numbers of the equations of the method, in their order."""
    return [int(number) for number in re.findall(r"\\tag\{M(\d+)\}", METHOD)]


def test_equations_are_numbered_in_their_order() -> None:
    numbers = tags()
    assert numbers == sorted(set(numbers)), "one may be gone, but none stands twice"
    assert f"(M1) to (M{numbers[-1]})" in METHOD


@pytest.mark.parametrize("name", ["docs/method.md", "docs/reference/api.md", "examples/fleet_to_node.ipynb"])
def test_equations_that_are_named_exist(name: str) -> None:
    named = {int(number) for number in NUMBER.findall((ROOT / name).read_text())}
    assert named
    assert named <= set(tags())


@pytest.mark.parametrize("reason", get_args(HeldBack))
def test_every_reason_to_hold_a_branch_back_is_explained(reason: str) -> None:
    assert METHOD.partition("### Why a branch is held back")[2].count(f"\n| {reason} |") == 1


def test_every_verdict_is_explained() -> None:
    section = METHOD.partition("### Verdict of a vehicle")[2].partition("\n### ")[0]
    for verdict in get_args(Verdict):
        assert re.search(rf"\n\| {verdict} \||\*{verdict}\*", section), verdict


def notices() -> list[list[str]]:
    """Wording of each notice that the method explains, without its numbers and names."""
    section = METHOD.partition("### Notices of a run")[2].partition("\n\nWith `--trusted`")[0]
    texts = [line.split("|")[1] for line in section.splitlines() if line.startswith("| ")][1:]
    parts = [re.split(r"\.\.\.|\bN\b|;", text) for text in texts]
    return [[part.strip(" ,:") for part in each if part.strip(" ,:")] for each in parts]


def test_notices_are_explained_in_the_words_of_the_program() -> None:
    source = "".join(path.read_text() for path in sorted((ROOT / "calibrator").rglob("*.py")))
    said = re.sub(r'"\n\s*f?"', "", source)
    assert len(notices()) >= 12
    assert [part for each in notices() for part in each if part not in said] == []
