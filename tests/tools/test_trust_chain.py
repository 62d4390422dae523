"""The whole chain, from the drives of a fleet to corrected vehicles."""

import json
from pathlib import Path

import pytest

from bench import trust_chain
from tests.ecu_node.vehicles import LAYOUT


def chain(monkeypatch: pytest.MonkeyPatch, *options: object) -> None:
    monkeypatch.setattr("sys.argv", ["trust_chain", *map(str, options)])
    trust_chain.main()


@pytest.mark.long
def test_no_vehicle_of_a_fleet_is_made_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("fastsim")
    layout = tmp_path / LAYOUT.name
    layout.write_text(f"{LAYOUT.read_text()}\n[activation]\ntrial_s = 60\n")
    (tmp_path / "hv_powertrain.dbc").write_bytes(LAYOUT.with_suffix(".dbc").read_bytes())
    small = ("--vehicles", 40, "--minutes", 5, "--unseen-minutes", 3)
    chain(monkeypatch, "--layout", layout, *small, "--unmeasured", 2, 0.5)
    counts = json.loads(capsys.readouterr().out)
    assert counts["vehicles"] == 40
    assert counts["with_corrections"] > 15
    assert counts["refused"] == 0
    assert counts["deployed"] >= 0.9 * counts["with_corrections"]
    assert counts["made_worse"] == 0
    assert counts["error_median_published_a"] < 0.2 * counts["error_median_measured_a"]
    for kind in trust_chain.WRONG:
        assert counts[f"wrong_sets_on_trial_{kind}"] >= 8
        assert counts[f"of_these_passed_{kind}"] < 0.2 * counts[f"wrong_sets_on_trial_{kind}"]


def test_too_short_trips_are_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        chain(monkeypatch, "--unseen-minutes", 5)
    assert f"--unseen-minutes: the trial of {LAYOUT} alone takes 300 s; give more" in capsys.readouterr().err
