"""Layout and the DBC behind it: good ones are read, bad ones refused with file and place."""

from fractions import Fraction
from pathlib import Path

import pytest

from ecu_node.bus.wiring import Mode, branch_signals
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.layout import file_digest, read_layout
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, SMALL_LAYOUT, MakeDatabase


def test_layout_gives_source_resolution_and_offset_limit_of_its_branches(make_database: MakeDatabase) -> None:
    assert read_layout(LAYOUT).offset_limit_a == 150.0
    layout = make_database().layout
    assert layout.find_branch("heater").source == "Heater.Power"
    assert [make_database().current_step_a(name) for name in layout.branch_names] == [0.1, 0.05, 0.0]
    assert layout.offset_limit_a == pytest.approx(0.4 * 400.0)


def test_layout_with_byte_order_mark_is_read_and_its_digest_ignores_line_ends(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text(SMALL_LAYOUT, encoding="utf-8-sig")
    layout = read_layout(tmp_path / "x.toml")
    (tmp_path / "x.toml").write_text(SMALL_LAYOUT, encoding="utf-8-sig", newline="\r\n")
    assert layout.name == "small"
    assert read_layout(tmp_path / "x.toml").digest == layout.digest == file_digest(tmp_path / "x.toml")


E2E = '\n]\n[e2e]\nmessages = ["Net"]\nprofile ='
BATTERY = 'name = "battery", sign = 1, signal = "Pair.Battery"'


MISTAKES = [
    ("schema = 1", "schema = 2", "schema"),
    ('name = "small"', 'name = "small"\nextra = 1', "unknown key 'extra'; allowed are schema, name"),
    ('name = "small"', 'name = "small"\ndigest = "x"', "unknown key 'digest'"),
    ("schema = 1", f"schema = {'9' * 5000}", "not TOML"),
    ("full_scale_a = 400.0", "", "'full_scale_a' is missing"),
    ('name = "battery", sign = 1', 'name = "battery", sign = 2', "sign"),
    ('"Pair.Battery"', '"Battery"', r"'Message.Signal' as in the DBC is expected, found \"Battery\""),
    ("sign = 1", "sign = 1, timout_s = 1", "'battery': unknown key 'timout_s'; did you mean 'timeout_s'"),
    ("sign = 1", 'sign = 1, timeout_s = "x"', "'battery', timeout_s: Expected float, got str, found \"x\""),
    ('name = "battery"', 'name = "motor"', "motor is named twice"),
    (BATTERY, BATTERY + ', power = "Heater.Power"', "branch battery: give either 'signal'"),
    (', voltage = "Net.Voltage"', "", "branch heater: give either 'signal'"),
    ('"Net.Voltage"', '"Net.Voltage", quality = "PairOut.Quality"', "'quality' without 'corrected'"),
    ("full_scale_a", 'watch.input = "x"\nwatch.valid = [1]\nfull_scale_a', r"input: 'x' is no \[\[input\]\]"),
    ("full_scale_a", "watch.valid = [1]\nfull_scale_a", "give both 'input' and 'valid', or neither"),
    ("full_scale_a", "watch.valid = [nan]\nfull_scale_a", r"\[watch\], valid, entry number 1: .* found NaN"),
    ("\n]\n", f'{E2E} "P01"\nvalid = {{ window = 3, min_ok = 5, max_error = 0 }}\n', "min_ok = 5 of 3 frames;"),
    ('quality = "PairOut.Quality"', 'quality = "Net.Voltage"', "must be signals of one message"),
    ("\n]\n", '\n]\n[status]\nmessage = "S"\nstate = "A"\nreason = "B"\nperiod_s = 0.001\n', "period_s: .* >= 0.01, "),
    ("\n]\n", f'{E2E} ["P01"]\n', r"profile: expected one of P01.*found \[\"P01\"\]"),
    ("sign = ", 'vss = "Vehicle.A", sign = ', "vss 'Vehicle.A' stands at two branches; each needs a name of"),
    ("sign = ", 'vss = "vehicle.A", sign = ', "'battery', vss: expected a name of the Vehicle Signal Spec"),
    ("full_scale_a", 'model_inputs = ["speed"]\nfull_scale_a', "model_inputs: 'speed' is no"),
    ('"Pair.Motor"', '"Pair.Battery"', "branches battery and motor: both read Pair.Battery"),
    ('"PairOut.Motor"', '"PairOut.Battery"', "PairOut.Battery is written twice"),
    ('"PairOut.Motor"', '"Pair.Motor"', "Pair.Motor is both read and written"),
    ("sign = ", "balance = true, sign = ", "more than one branch has 'balance = true'"),
    ("\n]\n", '\n]\ninput = [{ name = "x", signal = "PairOut.Quality" }]\n', "Quality is both read and written"),
]


@pytest.mark.parametrize(("old", "new", "words"), MISTAKES)
def test_a_layout_with_a_mistake_is_refused(make_database: MakeDatabase, old: str, new: str, words: str) -> None:
    assert old in SMALL_LAYOUT
    with pytest.raises(LayoutError, match=words) as caught:
        make_database(SMALL_LAYOUT.replace(old, new))
    assert "small.toml: " in str(caught.value)
    assert "$" not in str(caught.value)
    assert "\n" not in str(caught.value)


BEYOND_ENUM = """
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 256 14;
"""
WRONG_DBCS = [
    (SMALL_DBC.replace("BO_ 256 Pair:", "BO_ 256 Other:"), "no message 'Pair', which .*small.toml names"),
    (SMALL_DBC.replace("SG_ Voltage", "SG_ Volt"), "message Net has no signal 'Voltage', .* it has Volt"),
    (SMALL_DBC.replace('"V" Node', '"A" Node'), "branch heater: signal Voltage is in 'A'; expected V, mV, kV"),
    (SMALL_DBC.replace('"W" Node', '"V" Node'), "branch heater: signal Power is in 'V'; expected W"),
    (SMALL_DBC + "BO_ 258 Old: 2 Node\n", "small.dbc: messages Net and Old have one identifier, 0x102; take out"),
    (SMALL_DBC + BEYOND_ENUM, r"cannot read it \(DBC: \"list index .*\"\), as if an attribute \(BA_\) were"),
    (
        SMALL_DBC + 'BA_ "Cyce" BO_ 256 10;\n',
        r"cannot read it \(DBC: .*'Cyce'.*\), as if an attribute \(BA_\) were not",
    ),
    (SMALL_DBC.replace("SG_ Motor", "SG_ Battery"), "message Pair has several signals named 'Battery'; rename all but"),
    (SMALL_DBC + "BO_ 258 Pair: 2 Node\n", "small.dbc: 'Pair' is the name of several messages.*; rename all but one"),
    (
        SMALL_DBC.replace('(0.1,0) [-3000|3000] "A"', '(100,0) [-3000000|3000000] "mA"', 1).replace(
            '(0.1,0) [-3000|3000] "A"', '(0.1,0) [-3000|3000] ""'
        ),
        "branch battery: Pair.Battery is in mA, and PairOut.Battery has no unit in the DBC; give it its unit there",
    ),
    ("this is no dbc", "small.dbc: not a CAN database"),
    ("", "small.dbc: the DBC has no message"),
]


@pytest.mark.parametrize(("dbc", "words"), WRONG_DBCS)
def test_a_dbc_that_lacks_what_the_layout_names_is_refused(make_database: MakeDatabase, dbc: str, words: str) -> None:
    with pytest.raises(DatabaseError, match=words) as caught:
        make_database(SMALL_LAYOUT, dbc)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("unit", ["", "A"])
def test_unit_of_a_branch_is_that_of_its_corrected_signal_too(make_database: MakeDatabase, unit: str) -> None:
    layout = SMALL_LAYOUT.replace('"battery", sign = 1,', '"battery", sign = 1, unit = "mA",')
    dbc = SMALL_DBC.replace('(0.1,0) [-3000|3000] "A"', f'(100,0) [-3000000|3000000] "{unit}"')
    signals = branch_signals(database := make_database(layout, dbc), database.layout.branch[0], Mode.OVERLAY)
    assert signals.source.scale == signals.target.scale == Fraction(1, 10)


@pytest.mark.parametrize(("code", "of_battery", "of_power"), [
    (-1, -1, 65535), (65535, -1, 65535), (-32768, -32768, 32768), (32768, -32768, 32768), (70000, None, None),
])  # fmt: skip
def test_named_codes_count_as_they_are_read_whether_written_with_a_sign_or_without(
    make_database: MakeDatabase, code: int, of_battery: int | None, of_power: int | None
) -> None:
    names = f'VAL_ 256 Battery {code} "Error";\nVAL_ 2147484160 Power {code} "Error";\n'
    database = make_database(SMALL_LAYOUT, SMALL_DBC.replace('VAL_ 256 Battery -32768 "SNA";\n', names))
    for name, expected in (("Pair.Battery", of_battery), ("Heater.Power", of_power)):
        assert [*(database.signal(name)[1].choices or {})] == [expected] * (expected is not None)


@pytest.mark.filterwarnings("ignore:cantools.database.diagnostics")
def test_a_diagnostics_database_is_refused(make_database: MakeDatabase, tmp_path: Path) -> None:
    (tmp_path / "ecu.cdd").write_text("<CANDELA><ECUDOC><ECU><VAR/></ECU></ECUDOC></CANDELA>")
    with pytest.raises(DatabaseError, match=r"ecu.cdd: a diagnostics database; a CAN database \(DBC\) is needed"):
        make_database(SMALL_LAYOUT.replace("small.dbc", "ecu.cdd"))


@pytest.mark.parametrize("mark", [1 << 31, 0])
@pytest.mark.parametrize("more", ["", 'VAL_ 258 Gone 1 "On";\n'])
def test_dbc_with_unmarked_29_bit_ids_or_stray_names_is_read(make_database: MakeDatabase, mark: int, more: str) -> None:
    """Many public DBCs have such identifiers, and value tables of signals that do not exist."""
    number = mark | 0x18FF0200
    texts = f'CM_ SG_ {number} Power "Taken up";\nVAL_ {number} Power 65535 "SNA";\n'
    database = make_database(dbc=SMALL_DBC.replace("BO_ 2147484160", f"BO_ {number}") + texts + more)
    heater, pair = database.message("Heater"), database.message("Pair")
    power, battery = heater.get_signal_by_name("Power"), pair.get_signal_by_name("Battery")
    assert (heater.frame_id, heater.is_extended_frame) == (0x18FF0200, True)
    assert (power.comment, power.choices, battery.choices) == ("Taken up", {65535: "SNA"}, {-32768: "SNA"})
