"""The whole chain, from the drives of a fleet to corrected vehicles."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import trust_chain
from tests.ecu_node.vehicles import LAYOUT

pytest.importorskip("fastsim")


def short_trials(folder: Path) -> Path:
    """The project's own layout, with a trial of 60 s."""
    layout = folder / LAYOUT.name
    layout.write_text(f"{LAYOUT.read_text()}\n[activation]\ntrial_s = 60\n")
    dbc = LAYOUT.with_suffix(".dbc")
    (folder / dbc.name).write_bytes(dbc.read_bytes())
    return layout


@pytest.mark.long
def test_no_vehicle_of_a_fleet_is_made_worse(tmp_path: Path) -> None:
    options = ["--layout", str(short_trials(tmp_path)), "--vehicles", "24", "--minutes", "5", "--unseen-minutes", "3"]
    command = [sys.executable, trust_chain.__file__, *options, "--unmeasured", "2", "0.5", "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    counts = json.loads(result.stdout)
    assert counts["vehicles"] == 24
    assert counts["with_corrections"] > 15
    assert counts["refused"] == 0
    assert counts["deployed"] >= 0.9 * counts["with_corrections"]
    assert counts["made_worse"] == 0
    assert counts["error_median_published_a"] < 0.2 * counts["error_median_measured_a"]
    for kind in ("signs_turned", "of_another_vehicle"):
        assert counts[f"wrong_sets_on_trial_{kind}"] >= 8
        assert counts[f"of_these_passed_{kind}"] < 0.2 * counts[f"wrong_sets_on_trial_{kind}"]


def test_trips_that_end_before_the_trial_does_are_refused() -> None:
    result = CliRunner().invoke(trust_chain.app, ["--layout", str(LAYOUT), "--unseen-minutes", "5"])
    assert result.exit_code != 0
    assert f"--unseen-minutes 5: the trial of {LAYOUT} alone takes 300 s" in str(result.exception)
