"""Tables of experiments on narrow terminals: broken, never cut."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from calibrator.experiments.pages import result_table
from calibrator.experiments.runner import read_records

RESULTS = sorted((Path(__file__).parents[3] / "docs" / "results").glob("*.json"))


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
@pytest.mark.parametrize("width", [80, 60])
def test_a_table_of_results_is_as_wide_as_the_terminal_and_nothing_is_cut(path: Path, width: int) -> None:
    out = io.StringIO()
    (result,) = read_records(path.parent, [path.stem])
    Console(width=width, file=out).print(result_table(result))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in out.getvalue()
    assert "\x1b" not in out.getvalue()
