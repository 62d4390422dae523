"""Sensor models in the parameter file, and the temperature in the layout."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from msgspec.structs import replace

from ecu_node.cli import main
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError, UnfitError
from ecu_node.layout import read_layout
from ecu_node.parameter_fit import check_fit
from ecu_node.parameters import VehicleParameters, parameter_schema, read_parameters, write_parameters
from ecu_node.sensor_models import GainBySign, SensorModel, TemperatureDrift
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, as_document, parameters_for

MODELS = (
    GainBySign(drift_positive=0.1, drift_negative=-0.02, difference_sd=0.01),
    TemperatureDrift(drift_per_k=0.002, reference_c=31.5),
)


def _bent(database: VehicleDatabase, model: SensorModel) -> VehicleParameters:
    parameters = parameters_for(database, battery=(0.1, 1.0), motor=(0.05, 0.0))
    battery = replace(parameters.branches["battery"], sensor_model=model)
    return replace(parameters, branches={**parameters.branches, "battery": battery})


@pytest.mark.parametrize("model", MODELS)
def test_a_sensor_model_is_read_back_and_matches_the_schema(
    database: VehicleDatabase, tmp_path: Path, model: SensorModel
) -> None:
    parameters = _bent(database, model)
    write_parameters(parameters, tmp_path / "p.json")
    assert read_parameters(tmp_path / "p.json") == parameters
    document = json.loads((tmp_path / "p.json").read_text())
    jsonschema.Draft202012Validator(parameter_schema()).validate(document)
    assert document["branches"]["motor"]["sensor_model"] is None


@pytest.mark.parametrize(
    "model",
    [
        {"kind": "cubic"},
        {"drift_per_k": 0.1},
        {"kind": "temperature"},
        {"kind": "gain by sign", "drift_positive": 2.0, "drift_negative": 0.0},
    ],
)
def test_what_is_no_sensor_model_is_refused(database: VehicleDatabase, tmp_path: Path, model: dict[str, Any]) -> None:
    document = as_document(parameters_for(database, battery=(0.1, 1.0)))
    document["branches"]["battery"]["sensor_model"] = model
    (tmp_path / "p.json").write_text(json.dumps(document))
    with pytest.raises(UnfitError, match=r"not a parameter file: .*sensor_model"):
        read_parameters(tmp_path / "p.json")


def test_check_shows_the_plans_of_a_gain_by_sign(
    tmp_path: Path, make_database: Callable[..., VehicleDatabase], capsys: pytest.CaptureFixture[str]
) -> None:
    database = make_database(dbc=SMALL_DBC)
    path = tmp_path / "bent.json"
    write_parameters(_bent(database, MODELS[0]), path)
    assert main(["check", "--params", str(path), "--layout", str(database.layout.path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    battery = next(index for index, line in enumerate(lines) if line.startswith("battery"))
    assert lines[battery].endswith("A  corrected")
    assert lines[battery + 2].startswith("  sensor model 'gain by sign', positive currents: gain ")
    assert lines[battery + 3].startswith("  sensor model 'gain by sign', negative currents: gain ")


def test_a_branch_that_needs_a_temperature_that_the_layout_lacks_is_passed_through_and_said(
    tmp_path: Path, make_database: Callable[..., VehicleDatabase], capsys: pytest.CaptureFixture[str]
) -> None:
    database = make_database(dbc=SMALL_DBC)
    path = tmp_path / "bent.json"
    write_parameters(_bent(database, MODELS[1]), path)
    assert main(["check", "--params", str(path), "--layout", str(database.layout.path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert next(line for line in lines if line.startswith("battery")).endswith("A  passed through")
    assert next(line for line in lines if line.startswith("motor")).endswith("A  corrected")
    assert lines[-1].startswith("warning: branch battery is passed through: its fault depends on the temperature, and")


@pytest.mark.parametrize(("positive", "negative"), [(0.5, 0.0), (0.0, -0.41)])
def test_a_gain_beyond_the_limits_does_not_fit(database: VehicleDatabase, positive: float, negative: float) -> None:
    model = GainBySign(drift_positive=positive, drift_negative=negative)
    with pytest.raises(UnfitError, match=r"branch battery: drift [+-]0\.\d+ is beyond the layout's limit of 0\.4"):
        check_fit(_bent(database, model), database, None)


def test_the_projects_own_layout_names_its_temperature() -> None:
    assert read_layout(LAYOUT).temperature == "junction_box_temperature"


def test_a_temperature_that_is_no_input_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    path.write_text(LAYOUT.read_text().replace('temperature = "junction_box_temperature"', 'temperature = "oil"'))
    with pytest.raises(LayoutError, match=r"layout\.toml: temperature: 'oil' is no \[\[input\]\]; declare the signal"):
        read_layout(path)
