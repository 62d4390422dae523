"""What docs/experiments.md says of keys and headings is what records and tables have."""

import re
from pathlib import Path

from calibrator.experiments import outcome
from calibrator.experiments.table import DETAILS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "experiments.md").read_text()


def explained() -> dict[str, str]:
    """Headings by key, of the table."""
    rows = re.findall(r"(?m)^\| (`[a-z0-9_`, ]+) \| (.+?) \| .+ \|$", PAGE.partition("| key | heading |")[2])
    found: dict[str, str] = {}
    for keys, headings in rows:
        names, texts = re.findall(r"`(.+?)`", keys), re.findall(r"`(.+?)`", headings)
        found |= dict(zip(names, texts, strict=True)) if len(names) > 1 else {names[0]: headings.replace("`", "")}
    return found


def test_every_key_is_explained_with_its_heading() -> None:
    shown = explained()
    headings = {key: shown[key].removeprefix("name of the method, ") for key in DETAILS}
    assert headings == DETAILS
    assert set(shown) == {*DETAILS, "failed"}


def test_every_key_is_defined_by_the_module_that_the_page_links() -> None:
    assert outcome.__doc__ is not None
    assert [key for key in explained() if key not in outcome.__doc__] == []
    assert "[`calibrator.experiments.outcome`](reference/api.md#" in PAGE
