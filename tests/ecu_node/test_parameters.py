"""The parameter file: schema and reader agree, and whatever is wrong is refused in one line, with a reason."""

import codecs
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import ecu_node
from ecu_node.bus.wiring import InForce, Mode, choose_parameters, put_in_force, wire
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
    decode_parameters,
    parameter_schema,
    read_parameters,
    write_parameters,
)
from tests.disk import full_disk
from tests.ecu_node.processes import ecu_node as run_node
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, as_document, corrector_for, parameters_for, places

SCHEMA_FILE = Path(ecu_node.__file__).parent / "parameters.schema.json"
VALIDATOR = jsonschema.Draft202012Validator(parameter_schema())


def is_readable(content: object) -> bool:
    try:
        decode_parameters(json.dumps(content).encode(), "p")
    except UnfitError:
        return False
    return True


def test_published_json_schema_matches_the_data_structures() -> None:
    assert json.loads(SCHEMA_FILE.read_text()) == parameter_schema() == json.loads(run_node("schema").out)


def test_written_parameters_are_read_back_and_match_the_schema(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = parameters_for(database, battery=(0.1, -2.5))
    write_parameters(parameters, tmp_path / "p.json")
    assert read_parameters(tmp_path / "p.json") == parameters
    text = (tmp_path / "p.json").read_text()
    assert text.startswith('{\n  "schema_version": 1,\n'), "people read it, too"
    VALIDATOR.validate(json.loads(text))
    assert [path.name for path in tmp_path.iterdir()] == ["p.json"]


SOUND = BranchParameters(drift=0.1, offset_a=-2.5, apply=True)


VIOLATIONS = [
    ("branches", lambda x: {"battery": replace(SOUND, drift=x)}, r"branches\[\.\.\.\]\.drift"),
    ("branches", lambda x: {"battery": replace(SOUND, drift_sd=x)}, "a standard deviation .* is not finite"),
    ("confidence", lambda x: x, "the confidence is not finite"),
    ("hardware_fault", lambda x: HardwareFault(suspected=True, offset_a={"motor": x}), r"hardware_fault\.offset_a"),
    ("junction_residual", lambda x: JunctionResidual(measured_a=x, corrected_a=0), r"residual\.measured_a"),
    ("number", lambda _: 0, r"\$\.number"),
]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("field", "change", "words"), VIOLATIONS)
def test_parameters_that_violate_the_schema_are_not_written(
    database: VehicleDatabase, tmp_path: Path, field: str, change: Callable[[float], object], words: str, number: float
) -> None:
    parameters = replace(parameters_for(database, battery=(0.1, 0.0)), **{field: change(number)})
    (tmp_path / "p.json").write_text("older")
    with pytest.raises(ParameterError, match=rf"p\.json: .*{words}.*; nothing was written$") as caught:
        write_parameters(parameters, tmp_path / "p.json")
    assert "\n" not in str(caught.value)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("p.json", "older")]


values = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 300), st.floats(-2, 2).filter(lambda x: x != int(x)), st.text(max_size=3),
    st.sampled_from([[], {}, {"a": 1}, *("a" * length for length in (64, 65, 500, 501))]),
)  # fmt: skip


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_schema_and_reader_agree_on_any_change_of_a_document(database: VehicleDatabase, data: st.DataObject) -> None:
    finding = {"branch": "battery", "cause": "inverted", "probability": 0.99, "text": "battery: its sign is turned."}
    document = as_document(parameters_for(database, battery=(0.1, -2.5))) | {"findings": [finding]}
    container, key = data.draw(st.sampled_from([*places(document), (document, "extra")]))
    if key == "extra" or data.draw(st.booleans()):
        container[key] = data.draw(values)
    else:
        del container[key]
    assert is_readable(document) == VALIDATOR.is_valid(document)


SHA = "0" * 64
DIGESTS = r"\(0{12}\), this is .*hv_powertrain\.\w+ \([0-9a-f]{12}\); calibrate with this"


FOREIGN = [
    ("battery", {"vehicle": "v3"}, Reason.WRONG_VEHICLE, "are for vehicle 'v3', this is 'v1'"),
    ("battery", {"layout": {"name": "l", "sha256": SHA}}, Reason.WRONG_LAYOUT, rf"with layout l {DIGESTS} layout;"),
    ("battery", {"dbc": {"name": "d", "sha256": SHA}}, Reason.WRONG_DBC, rf"with DBC d {DIGESTS} DBC; .*template"),
    ("fridge", {}, Reason.WRONG_LAYOUT, "branch 'fridge', which .* does not have"),
]


@pytest.mark.parametrize(
    ("branch", "change", "reason", "words"), FOREIGN, ids=["vehicle", "layout", "DBC", "branch that the layout lacks"]
)
def test_parameters_of_another_vehicle_layout_or_dbc_are_unfit(
    database: VehicleDatabase, branch: str, change: dict[str, Any], reason: Reason, words: str
) -> None:
    document = as_document(parameters_for(database, **{branch: (0.1, 1.0)})) | change
    with pytest.raises(UnfitError, match=words) as caught:
        check_fit(decode_parameters(json.dumps(document).encode(), "p"), database, "v1")
    assert caught.value.reason is reason
    for own in ("v1", None):
        check_fit(parameters_for(database, battery=(0.4, -150.0)), database, own)


def test_rms_about_the_expected_sum_follows_from_rms_and_mean() -> None:
    measured_a, corrected_a, expected_a = [3.0, 5.0, -1.0, 7.0], [2.5, 2.0, 3.5, 3.0], 3.0

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


def test_file_of_version_1_0_is_read_unless_it_has_a_sensor_model(database: VehicleDatabase, tmp_path: Path) -> None:
    document = as_document(parameters_for(database, battery=(0.1, 1.0), motor=(0.1, 1.0)))
    document["branches"]["motor"]["sensor_model"] = None
    del document["findings"]
    check_fit(decode_parameters(json.dumps(document).encode(), "p"), database, None)
    model = {"kind": "gain by sign", "drift_positive": 0.1, "drift_negative": 0.0, "difference_sd": None}
    document["branches"]["motor"]["sensor_model"] = model
    (tmp_path / "p.json").write_text(json.dumps(document))
    words = (
        r"p\.json: not a parameter file: branches, motor, sensor_model: Expected null, got object, found .*; .* "
        r"write it anew with 'calibrator calibrate'$"
    )
    with pytest.raises(UnfitError, match=words):
        read_parameters(tmp_path / "p.json")


BEYOND_LIMITS = [
    ({"expected_a": 150.5}, r"an expected Kirchhoff sum of \+150\.5 A is beyond .* limit of offsets, 150 A$"),
    ({"expected_a": -150.5}, r"an expected Kirchhoff sum of -150\.5 A is beyond"),
    ({"delay_s": 5.5, "apply": False}, r"branch battery: delay \+5\.5 s is beyond 5 s"),
    ({"delay_s": -5.5}, r"branch battery: delay -5\.5 s is beyond 5 s"),
    ({"drift": -0.5}, r"branch battery: drift -0\.5 is beyond the layout's limit of 0\.4"),
    ({"offset_a": 151.0}, r"branch battery: offset \+151 A is beyond the layout's limit of 150 A"),
    ({"drift": 0.4, "offset_a": -150.0, "delay_s": 5.0}, None),
    ({"drift": -0.5, "offset_a": 151.0, "apply": False}, None),
    ({"expected_a": -150.0, "delay_s": None}, None),
]


@pytest.mark.parametrize(("change", "words"), BEYOND_LIMITS)
def test_values_beyond_limits_are_unfit(database: VehicleDatabase, change: dict[str, Any], words: str | None) -> None:
    expected = {key: value for key, value in change.items() if key == "expected_a"}
    residual = JunctionResidual(measured_a=1.0, corrected_a=0.1, **expected)
    branches = {"battery": replace(SOUND, **{key: change[key] for key in change.keys() - expected})}
    parameters = replace(parameters_for(database, battery=(0, 0)), branches=branches, junction_residual=residual)
    if words is None:
        check_fit(parameters, database, "v1")
        return
    with pytest.raises(UnfitError, match=f"^{words}") as caught:
        check_fit(parameters, database, "v1")
    assert caught.value.reason is Reason.IMPLAUSIBLE_PARAMETERS


@pytest.mark.parametrize("verdict", ["no sensor fault", "cannot tell", "not enough data"])
def test_branch_corrected_with_another_verdict_is_unfit(database: VehicleDatabase, verdict: Verdict) -> None:
    parameters = replace(parameters_for(database, battery=(0.1, 1.0), motor=(0.1, 1.0)), verdict=verdict)
    withheld = {name: replace(branch, apply=False) for name, branch in parameters.branches.items()}
    check_fit(replace(parameters, branches=withheld), database, "v1")
    one = replace(parameters, branches={**withheld, "motor": SOUND})
    for wrong, names in ((one, "motor"), (parameters, "battery, motor")):
        with pytest.raises(UnfitError, match=f"verdict '{verdict}', yet 'apply' is true for {names}; ") as caught:
            check_fit(wrong, database, "v1")
        assert caught.value.reason is Reason.IMPLAUSIBLE_PARAMETERS


def instead(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    def change(content: bytes) -> bytes:
        assert old in content
        return content.replace(old, new, 1)

    return change


def with_value(value: object, *place: str) -> Callable[[bytes], bytes]:
    def change(content: bytes) -> bytes:
        table = document = json.loads(content)
        for key in place[:-1]:
            table = table[key]
        table[place[-1]] = value
        return json.dumps(document).encode()

    return change


NUMBER = b'"number":300'


MALFORMED = [
    (b"", "it is empty; correct it, or write it anew with 'calibrator calibrate'"),
    (b"{", "JSON is malformed|Input data was truncated"),
    (b"[]", "Expected object, got array"),
    (b"\xff\xfe{}", "JSON is malformed"),
    (b'{"vehicle": "\xff"}', "it is no text in UTF-8; correct it"),
    (b'{"branches": ' + b'{"a":' * 100_000, "it is nested too deeply; correct it"),
    (b'{"vehicle": v1}', r"JSON is malformed: .*\(byte 12\)"),
    (b" " * (MAX_FILE_BYTES + 1), f"it is larger than {MAX_FILE_BYTES} bytes"),
    (instead(b"{", codecs.BOM_UTF8 + b"{"), r"it begins with .*\(BOM\); save it as UTF-8 without one; correct"),
    (instead(NUMBER, b'"number":9007199254740992'), "number: "),
    *((instead(b"-2.5", number), "") for number in (b"NaN", b"Infinity", b"-Infinity", b"1e999", b"9" * 400)),
    (instead(NUMBER, b'"number":' + b"[" * 100_000 + b"]" * 100_000), "it is nested too deeply"),
    (instead(b'"v1"', b'"' + b"v" * 300 + b'"'), r"vehicle: .*\.\.\. \(300 characters\)"),
    (instead(NUMBER, NUMBER + b"," + NUMBER), "key 'number' stands twice in one table; leave one of them; correct"),
    (instead(b'"motor":', b'"motor":{"drift":0.0,"offset_a":0.0,"apply":true},"motor":'), "key 'motor' stands twice"),
    (with_value("x", "branches", "motor", "drift"), 'branches, motor, drift: Expected float, got str, found "x"'),
    (with_value(2, "branches", "motor", "drift"), "branches, motor, drift: Expected float < 1.0, found 2;"),
    (with_value(0, "branches", "motor", "drifts"), "branches, motor: unknown key 'drifts'; did you mean 'drift'"),
    (
        with_value({"c": True}, "hardware_fault", "offset_a"),
        "hardware_fault, offset_a, c: Expected float, got bool, found true",
    ),
    (with_value("fine", "verdict"), "verdict: .*'cannot tell' or .*, found \"fine\""),
    (with_value([1], "provenance", "drives"), "provenance, drives, entry number 1: Expected str, got int, found 1"),
    (with_value("", "vehicle"), 'vehicle: Expected str of length >= 1, found ""'),
    (with_value({}, "branches"), "branches: Expected object of length >= 1, found {}"),
    (with_value("abc", "dbc", "sha256"), 'dbc, sha256: expected SHA-256: 64 digits 0-9 and a-f, found "abc"'),
]


@pytest.mark.parametrize(
    ("content", "words"), MALFORMED, ids=[words or "not a finite number" for _, words in MALFORMED]
)
def test_malformed_parameter_file_is_refused_in_one_line(
    database: VehicleDatabase, tmp_path: Path, content: bytes | Callable[[bytes], bytes], words: str
) -> None:
    sound = msgspec.json.encode(parameters_for(database, battery=(0.1, -2.5), motor=(0.1, 1.0)))
    (tmp_path / "p.json").write_bytes(content if isinstance(content, bytes) else content(sound))
    with pytest.raises(UnfitError, match=rf"^{tmp_path}/p\.json: not a parameter file: ({words})") as caught:
        read_parameters(tmp_path / "p.json")
    assert caught.value.reason is Reason.MALFORMED_PARAMETERS
    assert str(caught.value).isprintable()
    assert not {"$", "`"} & set(str(caught.value))


UNREADABLE = [
    ("missing.json", r"missing\.json: no such parameter file", Reason.NO_PARAMETERS),
    ("p.json/within", "/within: cannot read the parameter file: Not a directory; name", Reason.NO_PARAMETERS),
    ("", "not a parameter file: it is a folder", Reason.MALFORMED_PARAMETERS),
]


@pytest.mark.parametrize(("name", "words", "reason"), UNREADABLE)
def test_missing_or_unreadable_parameter_file_is_refused(tmp_path: Path, name: str, words: str, reason: Reason) -> None:
    (tmp_path / "p.json").write_bytes(b"{}")
    with pytest.raises(UnfitError, match=words) as caught:
        read_parameters(tmp_path / name)
    assert caught.value.reason is reason


def test_full_disk_keeps_the_previous_parameter_file(database: VehicleDatabase, tmp_path: Path) -> None:
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.25, 5.0)), path)
    before = path.read_bytes()
    with full_disk(100), pytest.raises(OSError, match="File too large"):
        write_parameters(parameters_for(database, battery=(0.5, 5.0)), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# ---- parameters of a node, at its start and while it runs


SPOILT = {
    "half written": (lambda whole: whole[:300], Reason.MALFORMED_PARAMETERS, "not a parameter file"),
    "of another vehicle": (instead(b'"v1"', b'"v2"'), Reason.WRONG_VEHICLE, "parameters are for vehicle 'v2', this is"),
    "missing": (None, Reason.NO_PARAMETERS, "no such parameter file; name one that is there"),
}


@pytest.mark.parametrize(("spoil", "reason", "words"), SPOILT.values(), ids=SPOILT)
def test_unfit_parameter_file_is_not_used(
    database: VehicleDatabase, tmp_path: Path, spoil: Callable[[bytes], bytes] | None, reason: Reason, words: str
) -> None:
    """The node passes measured values through, and publishes why."""
    path = tmp_path / "v1.json"
    if spoil is not None:
        write_parameters(parameters_for(database, battery=(0.25, 5.0)), path)
        path.write_bytes(spoil(path.read_bytes()))
    in_force = choose_parameters(path, database, "v1")
    corrector = wire(database, in_force, 0.0)
    assert (corrector.branches[0].fault.drift, corrector.reason) == (0.0, reason)
    assert (in_force.why_not or "").startswith(f"{path}: {words}")


@pytest.mark.parametrize("mode", Mode)
def test_changing_parameters_has_the_same_effect_as_starting_with_them(make_database: MakeDatabase, mode: Mode) -> None:
    """Measured and corrected signal have different scales here, so that passing through needs a plan, too."""
    database = make_database(dbc=SMALL_DBC.replace("SG_ Battery : 0|16@1- (0.1,0)", "SG_ Battery : 0|16@1- (0.2,0)"))
    after = InForce(parameters=parameters_for(database, battery=(0.125, 5.0)))
    corrector, fresh = corrector_for(database, mode, motor=(0.0, 1.0)), wire(database, after, 2.0, mode=mode)
    put_in_force(corrector, database, after, 2.0, mode=mode)
    for live, new in zip(corrector.branches, fresh.branches, strict=True):
        assert (live.plan, live.fault, live.deadline_s) == (new.plan, new.fault, new.deadline_s)
