"""Links between documents lead to files and headings that exist."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "deploy/*.md", "docs/*.md", "docs/reference/*.md", "docs/results/*.md", "examples/*.ipynb")
    for path in ROOT.glob(pattern)
)


def text_of(path: Path) -> str:
    """Prose of a document: the text cells of a notebook, and no blocks of code."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return re.sub(r"(?ms)^```.*?^```", "", text)


def headings(path: Path) -> set[str]:
    """Anchors that code hosts, and the site, give the headings of a document."""
    titles = re.findall(r"(?m)^#+ (.+)$", text_of(path))
    plain = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).strip().lower() for title in titles]
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in plain}


def links(path: Path) -> Iterator[tuple[str, str]]:
    """File and heading of each relative link of a document; a heading of its own has no file."""
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(path)):
        if not re.match(r"[a-z]+:", target):
            file, _, heading = target.partition("#")
            yield file, heading


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_exist(path: Path) -> None:
    wrong = [file for file, _ in links(path) if not (path.parent / file).exists()]
    assert wrong == []
    wrong = [
        f"{file}#{heading}"
        for file, heading in links(path)
        if heading and heading not in headings(path.parent / file if file else path)
    ]
    assert wrong == []
