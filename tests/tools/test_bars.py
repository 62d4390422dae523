"""The bars of a release (limits in bars.toml) are compared with the results of experiments and benchmarks."""

import json
from contextlib import nullcontext
from pathlib import Path

import pytest

from bench import bars

MADE = "calibrator 1.1.0 of commit 0123456789ab, Python 3.13.0"
DOCS = Path(__file__).parents[2] / "docs"


def bench_rows(folder: Path, ratio: float, made: str = MADE) -> Path:
    """Write the row of a benchmark."""
    path = folder / "bench.json"
    path.write_text(json.dumps([{"name": "BLF log to drive", "value": 1.0, "ratio": ratio, "made": made}]))
    return path


def test_recorded_experiments_meet_the_bars_of_the_release(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):  # nothing was measured but one reader
        bars.main(bench=bench_rows(tmp_path, 30.0), results=DOCS / "results")
    lines = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("bench")]
    assert len(lines) > 30
    assert not [line for line in lines if "nan" in line or "MISSED" in line]


@pytest.mark.parametrize(("ratio", "verdict"), [(25.0, "met"), (24.9, "MISSED")])
def test_benchmark_ratio_below_its_bar_is_marked_as_missed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], ratio: float, verdict: str
) -> None:
    with pytest.raises(SystemExit, match="bars are missed that"):
        bars.main(bench=bench_rows(tmp_path, ratio), results=DOCS / "results")
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "BLF log" in line)
    assert line.split()[-1] == verdict


def test_shares_of_several_rows_are_averaged_by_their_numbers_of_cases(tmp_path: Path) -> None:
    rows = [("K=2", 0.5, 10), ("K=3", 0.0, 30), ("other", 1.0, 99)]
    same = {"x": 80.0, "method": "posterior", "figure": "harmed"}
    figures = [same | {"series": series, "value": value, "of": of} for series, value, of in rows]
    (tmp_path / "real.json").write_text(json.dumps({"figures": figures, "made": MADE}))
    figure = bars.Bars(tmp_path / "bench.json", tmp_path).figure
    value, behind = figure("real", "K=.*", "harmed", "<= 0")
    assert (value, behind.partition(", ")[0]) == (5 / 40, "5 of 40")
    assert figure("real", "K=.*", "each harmed", "<= 0")[0] == 0.5


@pytest.mark.parametrize(("mark", "expected"), [("", None), ("-dirty", "figures of 0123456789ab-dirty; expected")])
def test_figures_made_with_uncommitted_changes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mark: str, expected: str | None
) -> None:
    (tmp_path / "bars.toml").write_text('bars = [["bench", "BLF.*", "ratio", ">= 25"]]')
    monkeypatch.setattr(bars, "LIST", tmp_path / "bars.toml")
    bench = bench_rows(tmp_path, 30.0, MADE.replace("0123456789ab", f"0123456789ab{mark}"))
    with nullcontext() if expected is None else pytest.raises(SystemExit, match=expected):
        bars.main(bench=bench, results=DOCS / "results")
