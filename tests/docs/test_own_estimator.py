"""The example of an estimator of one's own is short, and does what its page says."""

import runpy
from pathlib import Path

import pytest

from calibrator.experiments import common_drive, trial

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_estimator.py"


def test_it_stands_beside_the_published_method_and_the_default(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    law, drive = trial.FleetLaw, common_drive.builtin_common_drive
    monkeypatch.setattr(trial, "FleetLaw", lambda **_: law(vehicles=40))
    monkeypatch.setattr(common_drive, "builtin_common_drive", lambda: drive(duration_s=300.0))
    runpy.run_path(str(EXAMPLE))
    shown = capsys.readouterr().out
    for name in ("perfect", "posterior", "own"):
        assert name in shown


def test_it_has_less_than_40_lines() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 40
