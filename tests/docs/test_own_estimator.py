"""The example of an estimator of one's own runs beside the built-in methods, and so does the program of its page."""

import re
import runpy
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from calibrator.experiments import experiments
from tests.calibrator.experiments.small_trials import small_fleet, write_store

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_example_estimator_is_compared_with_built_in_methods(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With small fleets, a short drive, one case."""
    for name, row in experiments.EXPERIMENTS.items():
        monkeypatch.setitem(experiments.EXPERIMENTS, name, row.small())
    real = experiments.EXPERIMENTS["real"]
    monkeypatch.setitem(experiments.EXPERIMENTS, "real", replace(real, settings=experiments.REAL[:1]))
    monkeypatch.setattr(experiments, "fleet_for", partial(experiments.fleet_for, quick=True))
    names = runpy.run_path(str(ROOT / "examples" / "own_estimator.py"))
    shown = capsys.readouterr().out
    for name in ("perfect", "posterior", "own"):
        assert name in shown
    write_store(tmp_path / "build" / "i3", small_fleet(trips=6, samples=1800).trips)
    (tmp_path / "dbc").symlink_to(ROOT / "dbc")
    monkeypatch.chdir(tmp_path)
    (recorded,) = re.findall(r"(?ms)^```python\n(.+?)^```", (ROOT / "docs" / "experiments.md").read_text())
    exec(recorded, names)
    shown = capsys.readouterr().out
    assert "2 repetitions, seed 0, drive 6 drives of i3" in " ".join(shown.split())
    for name in ("perfect", "posterior", "own"):
        assert name in shown
