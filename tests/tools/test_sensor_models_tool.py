import json

import pytest
from typer.testing import CliRunner

import sensor_models

pytest.importorskip("fastsim")


def test_what_becomes_of_a_drawn_fleet_is_printed_as_json() -> None:
    result = CliRunner().invoke(sensor_models.app, ["--vehicles", "8", "--share", "0.25", "--json"])
    assert result.exit_code == 0, result.output
    counts = json.loads(result.stdout)
    assert counts["not_linear"] == 2
    assert counts["deployed"] <= counts["decided"] <= counts["not_linear"]


def test_a_layout_that_is_not_there_is_told_in_one_line() -> None:
    result = CliRunner().invoke(sensor_models.app, ["--layout", "missing.toml"])
    assert result.exit_code != 0
    assert "missing.toml" in str(result.exception) + result.output
