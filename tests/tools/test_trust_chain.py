"""The whole chain, from the drives of a fleet to corrected vehicles."""

import json
from pathlib import Path

import pytest
from typer import BadParameter

from bench import trust_chain
from tests.ecu_node.vehicles import LAYOUT


@pytest.mark.long
def test_whole_chain_makes_no_vehicle_worse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("fastsim")
    layout = tmp_path / LAYOUT.name
    layout.write_text(f"{LAYOUT.read_text()}\n[activation]\ntrial_s = 60\n")
    (tmp_path / "hv_powertrain.dbc").write_bytes(LAYOUT.with_suffix(".dbc").read_bytes())
    trust_chain.main(layout=layout, vehicles=60, minutes=5, unseen_minutes=3, unmeasured=(2.0, 0.5))
    counts = json.loads(capsys.readouterr().out)
    assert counts["vehicles"] == 60
    assert counts["with_corrections"] > 22
    assert counts["refused"] == 0
    assert counts["deployed"] >= 0.9 * counts["with_corrections"]
    assert counts["made_worse"] == 0
    assert counts["error_median_published_a"] < 0.2 * counts["error_median_measured_a"]
    for kind in trust_chain.WRONG:  # a trial of a minute tells less than the usual one, which a tenth of them passes
        assert counts[f"wrong_sets_on_trial_{kind}"] >= 8
        assert counts[f"of_these_passed_{kind}"] < 0.3 * counts[f"wrong_sets_on_trial_{kind}"]


def test_trips_that_end_before_the_trial_does_are_refused() -> None:
    with pytest.raises(BadParameter, match=r"--unseen-minutes: the trial of .*\.toml alone takes 300 s; give more"):
        trust_chain.main(unseen_minutes=5)
