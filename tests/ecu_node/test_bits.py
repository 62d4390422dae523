"""Reading and writing signals in frames, compared with cantools."""

from pathlib import Path

import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given
from hypothesis import strategies as st

from ecu_node.core.signals import bit_place, placed_signal
from ecu_node.database import read_database
from ecu_node.errors import DatabaseError
from ecu_node.layout import read_layout


@st.composite
def placed_signals(draw: st.DrawFn) -> tuple[Message, Signal]:
    """A signal of any width, order and sign, somewhere in a frame of 1 to 64 bytes."""
    size = draw(st.integers(1, 64))
    length = draw(st.integers(1, min(64, 8 * size)))
    first = draw(st.integers(0, 8 * size - length))
    big = draw(st.booleans())
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    signal = Signal("S", start, length, "big_endian" if big else "little_endian", draw(st.booleans()))
    return Message(frame_id=1, name="M", length=size, signals=[signal], is_fd=size > 8), signal


@given(placed_signals(), st.data())
def test_put_writes_the_same_bits_as_cantools_and_no_others(case: tuple[Message, Signal], data: st.DataObject) -> None:
    message, signal = case
    place = bit_place(signal)
    before = data.draw(st.binary(min_size=message.length, max_size=message.length))
    assert {"S": place.extract(before)} == message.decode(before, scaling=False)
    raw = data.draw(st.integers(place.lowest, place.highest))
    payload = bytearray(before)
    place.put(payload, raw)
    own = int.from_bytes(message.encode({"S": -1 if signal.is_signed else place.highest}, scaling=False), "little")
    wanted = int.from_bytes(message.encode({"S": raw}, scaling=False), "little")
    assert place.mask == own
    assert int.from_bytes(payload, "little") == int.from_bytes(before, "little") & ~own | wanted
    assert place.extract(payload) == raw


def test_code_too_large_for_its_signal_is_refused_and_never_wraps() -> None:
    place = bit_place(Signal("S", start=0, length=8, is_signed=True))
    with pytest.raises(ValueError, match="128 does not fit into 8 bits"):
        place.put(bytearray(1), 128)


def test_signals_that_are_not_integers_of_1_to_64_bits_are_refused() -> None:
    with pytest.raises(DatabaseError, match="S is a floating-point number"):
        bit_place(Signal("S", start=0, length=32, conversion=BaseConversion.factory(is_float=True)))
    for start, length in ((0, 65), (-8, 8)):
        with pytest.raises(DatabaseError, match=f"has {length} bits from bit {start} on; 1 to 64 bits from 0 on are"):
            bit_place(Signal("S", start=start, length=length))


CUT_NAME = "PackStatus_loggingAndVitals_Page"
CUT_DBC = f"""BU_: A
BO_ 1 Pack: 8 A
 SG_ {CUT_NAME} M : 0|8@1+ (1,0) [0|1] "" A
 SG_ Current m1 : 8|16@1- (0.1,0) [-1000|1000] "A" A
BO_ 2 Motor: 8 A
 SG_ Current : 0|16@1- (0.1,0) [-1000|1000] "A" A
BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;
BA_ "SystemSignalLongSymbol" SG_ 1 {CUT_NAME} "{CUT_NAME}Index";
"""


def test_multiplexer_name_cut_to_32_characters_refers_to_the_full_name(tmp_path: Path) -> None:
    branch = '[[branch]]\nname = "{0}"\nsignal = "{0}.Current"\nsign = 1\n'
    branches = branch.format("Pack") + branch.format("Motor")
    (tmp_path / "a.dbc").write_text(CUT_DBC)
    (tmp_path / "a.toml").write_text(f'schema = 1\nname = "a"\ndbc = "a.dbc"\nfull_scale_a = 400\n{branches}')
    message, signal = read_database(read_layout(tmp_path / "a.toml")).signal("Pack.Current")
    assert signal.multiplexer_signal == f"{CUT_NAME}Index"
    codes = [placed_signal(message, signal).code(bytes([page, 7, *6 * [0]])) for page in (0, 1, 2)]
    assert codes == [None, 7, None]
    decoded = message.decode(b"\1\7\0\0\0\0\0\0")
    assert isinstance(decoded, dict)
    assert decoded["Current"] == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("above", "words"), [("Page", "has no signal 'Page'"), ("S", "multiplexes in a circle by 'S'")]
)
def test_missing_or_circular_multiplexer_is_refused_and_named(above: str, words: str) -> None:
    signal = Signal("S", start=8, length=8, multiplexer_ids=[1], multiplexer_signal=above)
    message = Message(frame_id=1, name="M", length=8, signals=[signal], strict=False)
    with pytest.raises(DatabaseError, match=f"message M {words}, the multiplexer of its signal S"):
        placed_signal(message, signal)
