"""The parameter file: schema and reader agree, and whatever is wrong is one line with a reason."""

import codecs
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

import ecu_node
from ecu_node.core.status import Reason, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import ParameterError
from ecu_node.parameters import (
    MAX_FILE_BYTES,
    BranchParameters,
    HardwareFault,
    JunctionResidual,
    Verdict,
    check_fit,
    parameter_schema,
    read_parameters,
    write_parameters,
)
from tests.ecu_node.vehicles import as_document, parameters_for

SCHEMA_FILE = Path(ecu_node.__file__).parent / "parameters.schema.json"
VALIDATOR = jsonschema.Draft202012Validator(parameter_schema())


def is_readable(path: Path, document: Any) -> bool:
    path.write_text(json.dumps(document))
    try:
        read_parameters(path)
    except UnfitError:
        return False
    return True


def test_the_published_schema_is_that_of_the_structures() -> None:
    assert json.loads(SCHEMA_FILE.read_text()) == parameter_schema()


def test_written_parameters_are_read_back_and_match_the_schema(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = parameters_for(database, battery=(0.1, -2.5))
    write_parameters(parameters, tmp_path / "p.json")
    assert read_parameters(tmp_path / "p.json") == parameters
    VALIDATOR.validate(json.loads((tmp_path / "p.json").read_text()))
    assert [path.name for path in tmp_path.iterdir()] == ["p.json"]


SOUND = BranchParameters(drift=0.1, offset_a=-2.5, apply=True)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("field", "change", "words"),
    [
        ("branches", lambda x: {"battery": replace(SOUND, drift=x)}, r"branches\[\.\.\.\]\.drift"),
        ("branches", lambda x: {"battery": replace(SOUND, drift_sd=x)}, "a standard deviation .* is not finite"),
        ("confidence", lambda x: x, "the confidence is not finite"),
        ("hardware_fault", lambda x: HardwareFault(suspected=True, offset_a={"motor": x}), r"hardware_fault\.offset_a"),
        ("junction_residual", lambda x: JunctionResidual(measured_a=x, corrected_a=0), r"residual\.measured_a"),
    ],
)
def test_numbers_that_json_lacks_are_not_written(
    database: VehicleDatabase, tmp_path: Path, field: str, change: Callable[[float], object], words: str, number: float
) -> None:
    parameters = replace(parameters_for(database, battery=(0.1, 0.0)), **{field: change(number)})
    with pytest.raises(ParameterError, match=rf"p\.json: .*{words}.*; nothing was written$") as caught:
        write_parameters(parameters, tmp_path / "p.json")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def _paths(value: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    below = value.items() if isinstance(value, dict) else ()
    return [path, *(deeper for key, item in below for deeper in _paths(item, (*path, key)))]


values = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 300), st.floats(-2, 2).filter(lambda x: x != int(x)), st.text(max_size=3),
    st.just([]), st.just({}), st.just({"a": 1}), st.just("a" * 64),
)  # fmt: skip


@given(data=st.data())
def test_schema_and_reader_agree_wherever_any_value_is_put(
    database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    document = as_document(parameters_for(database, battery=(0.1, -2.5)))
    path = data.draw(st.sampled_from(_paths(document)[1:]))
    place = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = data.draw(values)
    assert is_readable(tmp_path_factory.getbasetemp() / "p.json", document) == VALIDATOR.is_valid(document)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe{}",
        b'\xef\xbb\xbf{"vehicle": "v1"}',
        b'{"vehicle": "\xff"}',
        b"[" * 100_000,
        b'{"vehicle": ' + b"[" * 100_000,
        b'{"branches": ' + b'{"a":' * 100_000,
        b"not json at all\nsecond line",
        b" " * (MAX_FILE_BYTES + 1),
    ],
    ids=range(12),
)
def test_what_is_no_parameter_file_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "p.json"
    path.write_bytes(content)
    with pytest.raises(UnfitError, match=r"p\.json: ") as caught:
        read_parameters(path)
    assert caught.value.reason is Reason.MALFORMED_PARAMETERS
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_no_parameters(tmp_path: Path) -> None:
    with pytest.raises(UnfitError, match="no such parameter file") as caught:
        read_parameters(tmp_path / "missing.json")
    assert caught.value.reason is Reason.NO_PARAMETERS


@pytest.mark.parametrize(
    ("faults", "change", "vehicle", "reason", "words"),
    [
        ({"battery": (0.1, 1.0)}, {}, "v2", Reason.WRONG_VEHICLE, "are for vehicle 'v1', this is 'v2'"),
        ({"battery": (0.1, 1.0)}, {"layout": "0" * 64}, None, Reason.WRONG_LAYOUT, "000000000000.*calibrate.*template"),
        ({"battery": (0.1, 1.0)}, {"dbc": "0" * 64}, None, Reason.WRONG_DBC, "DBC .*000000000000.*template"),
        ({"fridge": (0.1, 1.0)}, {}, None, Reason.WRONG_LAYOUT, "branch 'fridge', which .* does not have"),
        ({"battery": (0.41, 1.0)}, {}, None, Reason.IMPLAUSIBLE_PARAMETERS, r"drift \+0.41 is beyond .* 0.4"),
        ({"motor": (0.1, -151.0)}, {}, None, Reason.IMPLAUSIBLE_PARAMETERS, "offset -151 A is beyond .* 150 A"),
    ],
)
def test_parameters_that_do_not_belong_here_are_unfit(
    database: VehicleDatabase,
    tmp_path: Path,
    faults: dict[str, tuple[float, float]],
    change: dict[str, str],
    vehicle: str | None,
    reason: Reason,
    words: str,
) -> None:
    document = as_document(parameters_for(database, **faults))
    for key, digest in change.items():
        document[key]["sha256"] = digest
    (tmp_path / "p.json").write_text(json.dumps(document))
    with pytest.raises(UnfitError, match=words) as caught:
        check_fit(read_parameters(tmp_path / "p.json"), database, vehicle)
    assert caught.value.reason is reason


@pytest.mark.parametrize("expected_a", [150.5, -150.5])
def test_an_expected_sum_beyond_the_limit_of_offsets_does_not_fit(database: VehicleDatabase, expected_a: float) -> None:
    residual = JunctionResidual(measured_a=1.0, corrected_a=0.1, expected_a=expected_a)
    words = rf"^an expected Kirchhoff sum of \{expected_a:+g} A is beyond the layout's limit of offsets, 150 A$"
    with pytest.raises(UnfitError, match=words) as caught:
        check_fit(replace(parameters_for(database, battery=(0.1, 1.0)), junction_residual=residual), database, "v1")
    assert caught.value.reason is Reason.IMPLAUSIBLE_PARAMETERS


@pytest.mark.parametrize("apply", [True, False])
@pytest.mark.parametrize("delay_s", [5.5, -5.5])
def test_a_delay_that_no_vehicle_has_does_not_fit(database: VehicleDatabase, delay_s: float, apply: bool) -> None:
    parameters = parameters_for(database, battery=(0.1, 1.0))
    with_delay = [replace(SOUND, apply=apply, delay_s=delay) for delay in (None, delay_s / 1.1, delay_s)]
    for branch in with_delay[:2]:
        check_fit(replace(parameters, branches={"battery": branch}), database, "v1")
    with pytest.raises(UnfitError, match=rf"^branch battery: delay \{delay_s:+g} s is beyond 5 s$") as caught:
        check_fit(replace(parameters, branches={"battery": with_delay[2]}), database, "v1")
    assert caught.value.reason is Reason.IMPLAUSIBLE_PARAMETERS


def test_sums_about_the_expected_one_are_those_of_the_samples() -> None:
    measured_a, corrected_a, expected_a = [3.0, 5.0, -1.0, 7.0], [1.5, 2.0, 2.5, 1.0], 2.0

    def rms(values: list[float]) -> float:
        return math.hypot(*values) / math.sqrt(len(values))

    means = {"measured_mean_a": math.fsum(measured_a) / 4, "corrected_mean_a": math.fsum(corrected_a) / 4}
    residual = JunctionResidual(
        measured_a=rms(measured_a), corrected_a=rms(corrected_a), expected_a=expected_a, **means
    )
    about = [rms([value - expected_a for value in values]) for values in (measured_a, corrected_a)]
    assert residual.about_expected() == pytest.approx(about)
    for unknown in means:
        assert replace(residual, **{unknown: None}).about_expected() == (residual.measured_a, residual.corrected_a)


def test_a_file_of_version_1_0_with_a_sensor_model_is_refused(database: VehicleDatabase, tmp_path: Path) -> None:
    document = as_document(parameters_for(database, battery=(0.1, 1.0), motor=(0.1, 1.0)))
    model = {"kind": "gain by sign", "drift_positive": 0.1, "drift_negative": 0.0, "difference_sd": None}
    document["branches"]["motor"]["sensor_model"] = model
    (tmp_path / "p.json").write_text(json.dumps(document))
    words = (
        r"p\.json: not a parameter file: branches, motor, sensor_model: Expected null, got object, found .*; .* "
        r"write it anew with 'calibrator calibrate'$"
    )
    with pytest.raises(UnfitError, match=words):
        read_parameters(tmp_path / "p.json")


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("branches", "motor", "drift"), "x", 'branches, motor, drift: Expected float, got str, found "x"'),
        (("branches", "motor", "drift"), 2, "branches, motor, drift: Expected float < 1.0, found 2;"),
        (("branches", "motor", "drifts"), 0, "branches, motor: unknown key 'drifts'; did you mean 'drift'"),
        (("hardware_fault", "offset_a"), {"b": 1, "c": True}, "offset_a, c: Expected float, got bool, found true"),
        (("verdict",), "fine", "verdict: .*'cannot tell' or .*, found \"fine\""),
        (("provenance", "drives"), [1], "provenance, drives, entry number 1: Expected str, got int, found 1"),
        (("vehicle",), "", 'vehicle: Expected str of length >= 1, found ""'),
        (("vehicle",), 65 * "v", "vehicle: Expected str of length <= 64, found"),
        (("branches",), {}, "branches: Expected object of length >= 1, found {}"),
        (("dbc", "sha256"), "abc", 'dbc, sha256: expected SHA-256: 64 digits 0-9 and a-f, found "abc"'),
    ],
)
def test_a_wrong_field_is_named_with_its_place_and_value(
    database: VehicleDatabase, tmp_path: Path, place: tuple[str, ...], value: object, words: str
) -> None:
    document = as_document(parameters_for(database, battery=(0.1, 1.0), motor=(0.1, 1.0)))
    *outer, last = place
    table = document
    for key in outer:
        table = table[key]
    table[last] = value
    (tmp_path / "p.json").write_text(json.dumps(document))
    with pytest.raises(UnfitError, match=words) as caught:
        read_parameters(tmp_path / "p.json")
    assert "$" not in str(caught.value)
    assert "`" not in str(caught.value)


@pytest.mark.parametrize("verdict", ["cannot tell", "not enough data"])
def test_what_was_not_decided_is_not_applied(database: VehicleDatabase, verdict: Verdict) -> None:
    parameters = replace(parameters_for(database, battery=(0.1, 1.0), motor=(0.1, 1.0)), verdict=verdict)
    withheld = {name: replace(branch, apply=False) for name, branch in parameters.branches.items()}
    check_fit(replace(parameters, branches=withheld), database, "v1")
    one = replace(parameters, branches={**withheld, "motor": SOUND})
    with pytest.raises(UnfitError, match=f"verdict '{verdict}', yet branch motor has 'apply': true") as caught:
        check_fit(one, database, "v1")
    assert caught.value.reason is Reason.IMPLAUSIBLE_PARAMETERS


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b'{"schema_version"', codecs.BOM_UTF8 + b'{"schema_version"', "it begins with a byte order mark (BOM)"),
        (b'"number":300', b'"number":299,"number":300', "'number' stands there twice in one place"),
        (b'"number":300', b'"number":299,"numbe\\u0072":300', "'number' stands there twice in one place"),
        (b'"battery":{', b'"battery":{"drift":0.5,', "'drift' stands there twice in one place"),
        (b'"battery":{', b'"battery":{"drift":"x"},"battery":{', "'battery' stands there twice in one place"),
        (b'"number":300', b'"number":9007199254740992', "number: "),
        (b'"number":300', b'"number":' + b"[" * 100_000 + b"]" * 100_000, "it is nested too deeply"),
        (b'"v1"', b'"' + b"v" * 300 + b'"', "vehicle: Expected str of length <= 64, found"),
        (b'"v1"', b'"' + b"v" * 300 + b'"', "... (300 characters)"),
    ],
)
def test_mistakes_of_a_file_that_was_written_by_hand_are_told(
    database: VehicleDatabase, tmp_path: Path, old: bytes, new: bytes, words: str
) -> None:
    content = msgspec.json.encode(parameters_for(database, battery=(0.1, -2.5)))
    assert content.count(old) >= 1
    (tmp_path / "p.json").write_bytes(content.replace(old, new, 1))
    with pytest.raises(UnfitError, match=re.escape(words)) as caught:
        read_parameters(tmp_path / "p.json")
    assert caught.value.reason is Reason.MALFORMED_PARAMETERS
    assert str(caught.value).startswith(f"{tmp_path}/p.json: not a parameter file: ")
    assert str(caught.value).endswith("; correct it, or write it anew with 'calibrator calibrate'")
    assert str(caught.value).isprintable()


def test_a_signed_file_in_the_place_of_one_that_nobody_signed_is_told(tmp_path: Path) -> None:
    (tmp_path / "p.json").write_bytes(b'{"payload":"","payloadType":"x","signatures":[]}\n')
    with pytest.raises(UnfitError, match=r"this file was signed by version 1\.0; name the parameter file"):
        read_parameters(tmp_path / "p.json")


Change = Callable[[dict[str, Any]], object]
FINDING = {"branch": "battery", "cause": "inverted", "probability": 0.99, "text": "battery: its sign is turned."}
CHANGES: dict[str, Change] = {
    "nothing": lambda d: None,
    "unknown key": lambda d: d.update(extra=1),
    "vehicle missing": lambda d: d.pop("vehicle"),
    "vehicle empty": lambda d: d.update(vehicle=""),
    "vehicle too long": lambda d: d.update(vehicle="x" * 65),
    "vehicle a number": lambda d: d.update(vehicle=5),
    "another schema version": lambda d: d.update(schema_version=2),
    "schema version a text": lambda d: d.update(schema_version="1"),
    "number 0": lambda d: d.update(number=0),
    "number with a fraction": lambda d: d.update(number=1.5),
    "number left out": lambda d: d.pop("number"),
    "no branches": lambda d: d.update(branches={}),
    "branches a list": lambda d: d.update(branches=[]),
    "17 branches": lambda d: d.update(branches={f"b{k}": d["branches"]["battery"] for k in range(17)}),
    "drift -1": lambda d: d["branches"]["battery"].update(drift=-1),
    "drift whole": lambda d: d["branches"]["battery"].update(drift=0),
    "drift a text": lambda d: d["branches"]["battery"].update(drift="0.1"),
    "drift true": lambda d: d["branches"]["battery"].update(drift=True),
    "drift null": lambda d: d["branches"]["battery"].update(drift=None),
    "deviation null": lambda d: d["branches"]["battery"].update(drift_sd=None),
    "deviation negative": lambda d: d["branches"]["battery"].update(drift_sd=-0.1),
    "offset missing": lambda d: d["branches"]["battery"].pop("offset_a"),
    "apply missing": lambda d: d["branches"]["battery"].pop("apply"),
    "apply a number": lambda d: d["branches"]["battery"].update(apply=1),
    "unknown verdict": lambda d: d.update(verdict="fine"),
    "confidence above 1": lambda d: d.update(confidence=1.01),
    "digest too short": lambda d: d["dbc"].update(sha256="ab"),
    "digest with more behind": lambda d: d["dbc"].update(sha256="a" * 64 + "b"),
    "fleet size 0": lambda d: d["provenance"].update(fleet_size=0),
    "a sensor model of null": lambda d: d["branches"]["battery"].update(sensor_model=None),
    "a sensor model": lambda d: d["branches"]["battery"].update(sensor_model={"kind": "temperature"}),
    "a finding": lambda d: d.update(findings=[FINDING]),
    "a finding without its branch": lambda d: d.update(findings=[{**FINDING, "branch": None}]),
    "a finding without its cause": lambda d: d.update(findings=[{**FINDING, "cause": ""}]),
    "a finding of many words": lambda d: d.update(findings=[{**FINDING, "text": "x" * 501}]),
    "a finding beyond certainty": lambda d: d.update(findings=[{**FINDING, "probability": 1.1}]),
    "65 findings": lambda d: d.update(findings=65 * [FINDING]),
}


def test_what_the_schema_refuses_is_not_written(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = parameters_for(database, battery=(0.1, 0.0))
    endless = replace(parameters, provenance=replace(parameters.provenance, duration_s=math.nan))
    empty = replace(parameters, provenance=replace(parameters.provenance, fleet_size=0))
    (tmp_path / "p.json").write_text("older")
    for bad, words in ((endless, "duration_s"), (empty, "fleet_size")):
        with pytest.raises(ParameterError, match=rf"\$\.provenance\.{words}"):
            write_parameters(bad, tmp_path / "p.json")
    assert (tmp_path / "p.json").read_text() == "older"


@pytest.mark.parametrize("name", CHANGES)
def test_schema_and_reader_agree(database: VehicleDatabase, tmp_path: Path, name: str) -> None:
    document = as_document(parameters_for(database, battery=(0.1, -2.5)))
    CHANGES[name](document)
    assert is_readable(tmp_path / "p.json", document) == VALIDATOR.is_valid(document)


def test_where_a_text_is_no_json_is_told(tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text('{"vehicle": v1}')
    with pytest.raises(
        UnfitError, match=r"p\.json: not a parameter file: JSON is malformed: .*\(byte 12\); correct it"
    ):
        read_parameters(tmp_path / "p.json")


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "9" * 400])
def test_numbers_beyond_all_bounds_are_refused(database: VehicleDatabase, tmp_path: Path, number: str) -> None:
    text = json.dumps(as_document(parameters_for(database, battery=(0.1, -2.5)))).replace("-2.5", number)
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(UnfitError, match=r"not a parameter file"):
        read_parameters(tmp_path / "p.json")


def test_parameters_made_for_this_vehicle_fit(database: VehicleDatabase) -> None:
    for vehicle in ("v1", None):
        check_fit(parameters_for(database, battery=(0.4, -150.0)), database, vehicle)


def test_limits_are_those_of_what_is_applied(database: VehicleDatabase) -> None:
    passed = {"battery": replace(SOUND, drift=-0.5, apply=False), "motor": replace(SOUND, offset_a=151.0, apply=False)}
    parameters = replace(parameters_for(database, battery=(0.1, 1.0)), branches=passed)
    check_fit(parameters, database, "v1")
    for name, words in (("battery", r"drift -0\.5 is beyond"), ("motor", r"offset \+151 A is beyond")):
        with pytest.raises(UnfitError, match=f"^branch {name}: {words}"):
            check_fit(replace(parameters, branches={name: replace(passed[name], apply=True)}), database, "v1")


def test_what_is_in_the_way_of_reading_is_told(tmp_path: Path) -> None:
    (tmp_path / "p.json").write_bytes(b"{}")
    with pytest.raises(
        UnfitError, match="/within: cannot read the parameter file: Not a directory; name one"
    ) as caught:
        read_parameters(tmp_path / "p.json" / "within")
    assert caught.value.reason is Reason.NO_PARAMETERS
    with pytest.raises(UnfitError, match="not a parameter file: it is a ") as caught:
        read_parameters(tmp_path)
    assert caught.value.reason is Reason.MALFORMED_PARAMETERS


def test_a_file_of_version_1_0_without_sensor_models_is_read(database: VehicleDatabase, tmp_path: Path) -> None:
    document = as_document(parameters_for(database, battery=(0.1, 1.0)))
    assert "sensor_model" not in document["branches"]["battery"]
    document["branches"]["battery"]["sensor_model"] = None
    del document["findings"]
    (tmp_path / "p.json").write_text(json.dumps(document))
    check_fit(read_parameters(tmp_path / "p.json"), database, None)
