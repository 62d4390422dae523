"""The demo at a small size: that its steps fit together, not its figures."""

from pathlib import Path

import pytest

import demo
from ecu_node.errors import UserError


@pytest.mark.long
def test_demo_runs_its_five_steps_and_draws_its_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, value in {"VEHICLES": 8, "BRANCHES": 2, "SECONDS": 1.0}.items():
        monkeypatch.setattr(demo, name, value)
    out = tmp_path / "demo"
    demo.main(drives="builtin", out=out)
    printed = capfd.readouterr().out
    assert [line[4] for line in printed.splitlines() if line.startswith("=== ")] == list("12345")
    assert "RMSE of the sum" in printed
    assert "put into V" in printed
    for picture in ("kirchhoff.html", "before_after.png"):
        assert (out / picture).stat().st_size > 0
    assert "#" in (out / "live.log").read_text()


def test_demo_does_not_empty_a_folder_that_it_did_not_make(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("1")
    with pytest.raises(UserError, match="is not empty and was not made by the demo; choose another folder"):
        demo.main(drives="builtin", out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_demo_refuses_a_folder_without_recordings(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not the BMW i3 recordings; give their folder, or leave DRIVES out"):
        demo.main(drives=str(tmp_path), out=tmp_path / "out")
