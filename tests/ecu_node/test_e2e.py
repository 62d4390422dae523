"""End-to-end protection: accepted and rejected frames; independent libraries find the frames intact."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ecu_node.core.e2e import Check, E2EState, Protection, Receiver, protection_of
from ecu_node.errors import LayoutError
from ecu_node.layout import E2EWindow
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, MakeDatabase

SIZE = 24
ROOM = (
    f'BO_ 700 Room: {SIZE} Node\n SG_ Count : 36|4@1+ (1,0) [0|15] "" Node\n SG_ Sum : 56|8@1+ (1,0) [0|255] "" Node\n'
)
COUNTER_CRC8 = 'profile = "counter CRC8"\nmessages = ["Room"]\ncounter = "Count"\ncrc = "Sum"\n'


OEM_AFTER = 'counter_modulus = 15\nalgorithm = "autosar"\ndata_id_bytes = 1\ndata_id_at = "after"'


def autosar(profile: str, *more: str) -> str:
    return "\n".join([f'profile = "{profile}"\nmessages = ["Room"]', *more])


KINDS = {
    "P01": (autosar("P01", "data_id = { Room = 0x1234 }"), 15, "ff0f"),
    "P01 alternating": (autosar("P01", 'data_id_mode = "alternating"'), 15, "ff0f"),
    "P01 further on": (autosar("P01", "offset = 1"), 15, "00ff0f"),
    "P01 nibble": (autosar("P01", 'data_id_mode = "nibble"\noffset = 3'), 15, "000000ffff"),
    "P02": (autosar("P02", f"data_id_list = {{ Room = {list(range(100, 116))} }}"), 16, "ff0f"),
    "P04": (autosar("P04", "data_id = { Room = 0x0A0B0C0D }"), 1 << 16, "ff" * 12),
    "P05": (autosar("P05", "offset = 2"), 256, "0000ffffff"),
    "P06": (autosar("P06", "data_id = { Room = 0x1234 }"), 256, "ff" * 5),
    "P06 further on": (autosar("P06", "offset = 3"), 256, "00" * 3 + "ff" * 5),
    "P07": (autosar("P07", "data_id = { Room = 0x0A0B0C0D }"), 1 << 32, "ff" * 20),
    "P11": (autosar("P11", "data_id = { Room = 0x123 }"), 15, "ff0f"),
    "P11 nibble": (autosar("P11", 'data_id_mode = "nibble"\noffset = 4'), 15, "00000000ffff"),
    "OEM": (COUNTER_CRC8 + "data_id_bytes = 2", 16, "00000000f00000ff"),
    "OEM after": (COUNTER_CRC8 + OEM_AFTER, 15, "00000000f00000ff"),
}
"""Entry of the layout, number of codes of the counter, and the bits that the profile writes."""
ENTRIES = {kind: entry for kind, (entry, _, _) in KINDS.items()}
OEM = ENTRIES["OEM"]


@pytest.fixture(params=list(KINDS))
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def protect(make_database: MakeDatabase) -> Callable[..., Protection]:
    def make(entry: str, *, head: str = "[e2e]", room: str = ROOM, message: str = "Room") -> Protection:
        database = make_database(f"{SMALL_LAYOUT}\n{head}\n{entry}\n", SMALL_DBC.replace("VAL_", room + "VAL_", 1))
        protection = protection_of(database, database.message(message))
        assert protection is not None
        return protection

    return make


@pytest.fixture
def protection(kind: str, protect: Callable[..., Protection]) -> Protection:
    return protect(ENTRIES[kind] + "\nmax_delta_counter = 3")


def stream(protection: Protection, count: int, size: int = SIZE, *, first: int = 0) -> list[bytearray]:
    """Frames in order, the first one with this counter."""
    payload = bytearray(b"\xa5" * size)
    protection.counter.put(payload, (first - 1) % protection.modulus)
    frames = []
    for _ in range(count):
        protection.advance(payload)
        frames.append(bytearray(payload))
    return frames


def damaged(frame: bytearray) -> bytearray:
    return frame[:-1] + bytes([frame[-1] ^ 1])


def test_counter_starts_at_0_and_wraps_and_frames_in_order_are_ok(kind: str, protection: Protection) -> None:
    frames, (_, modulus, _) = stream(protection, 300), KINDS[kind]
    assert protection.modulus == modulus
    assert [protection.counter_of(frame) for frame in frames] == [k % modulus for k in range(300)]
    check = Receiver(protection).check
    assert {check(frame) for frame in frames} == {Check.OK}


def test_frame_repeated_after_a_long_time_in_order_is_noticed_at_any_counter(protection: Protection) -> None:
    frames = stream(protection, 45)
    for last in range(29, 45):
        check = Receiver(protection).check
        assert {check(frame) for frame in frames[: last + 1]} == {Check.OK}
        assert check(frames[last]) is Check.REPEATED


def test_protection_writes_only_the_bits_of_its_header_mask(kind: str, protection: Protection) -> None:
    header = bytes.fromhex(KINDS[kind][2])
    assert protection.header_mask == int.from_bytes(header, "little")
    for frame in stream(protection, 20):
        changed = int.from_bytes(frame, "little") ^ int.from_bytes(b"\xa5" * SIZE, "little")
        assert changed & ~protection.header_mask == 0
    (all_header,) = stream(protection, 1, size=len(header))
    assert Receiver(protection).check(all_header) is Check.OK
    assert {Receiver(protection).check(bytearray(size)) for size in range(len(header))} == {Check.CORRUPT}


def test_corrupt_frame_changes_neither_the_expected_counter_nor_the_e2e_state(protection: Protection) -> None:
    (first, second), receiver = stream(protection, 2), Receiver(protection)
    found = [(receiver.check(frame), receiver.state) for frame in (damaged(first), first, damaged(second), second)]
    ok, corrupt = (Check.OK, E2EState.VALID), (Check.CORRUPT, E2EState.VALID)
    assert found == [(Check.CORRUPT, E2EState.INIT), ok, corrupt, ok]


def test_any_flipped_bit_is_detected_and_sealing_keeps_the_counter(protection: Protection) -> None:
    (frame,) = stream(protection, 1)
    for bit in range(8 * SIZE):
        flipped = bytearray((int.from_bytes(frame, "little") ^ 1 << bit).to_bytes(SIZE, "little"))
        assert Receiver(protection).check(flipped) is Check.CORRUPT
        counter = protection.counter_of(flipped)
        protection.seal(flipped)
        assert protection.is_sound(flipped)
        assert protection.counter_of(flipped) == counter


EXAMPLES = [
    (ENTRIES["P04"], "001000000a0b0c0d862b055600000000"),
    (ENTRIES["P05"].replace("offset = 2", "data_id = { Room = 0x1234 }"), "1cca000000000000"),
    (ENTRIES["P06"], "b155000800000000"),
    (ENTRIES["P07"], "1fb2e737fcedbcd900000018000000000a0b0c0d00000000"),
    (ENTRIES["P11"], "cc00000000000000"),
    (ENTRIES["P11"] + '\ndata_id_mode = "nibble"', "2a10000000000000"),
]


@pytest.mark.parametrize(("entry", "expected"), EXAMPLES)
def test_first_frame_equals_autosar_example(protect: Callable[..., Protection], entry: str, expected: str) -> None:
    payload = bytearray(len(bytes.fromhex(expected)))
    protection = protect(entry)
    protection.before_first(payload)
    protection.advance(payload)
    assert payload.hex() == expected


@pytest.mark.parametrize(("profile", "identity"), [("P04", 0x12345678), ("P05", 0x5678), ("P07", 0x12345678)])
def test_default_data_id_is_the_cut_message_id(protect: Callable[..., Protection], profile: str, identity: int) -> None:
    long = ROOM.replace("BO_ 700", f"BO_ {0x80000000 | 0x12345678}")
    protection = protect(autosar(profile, "offset = 3"), room=long)
    assert protection.identity == identity
    (frame,) = stream(protection, 1)
    assert (identity.to_bytes(4, "big") in frame) is (profile != "P05")  # which does not send it


def crc8(data: bytes, polynomial: int) -> int:
    """CRC-8 with start and final value 0xFF, bit by bit."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (polynomial if crc & 0x80 else 0)) & 0xFF
    return crc ^ 0xFF


CRCS = [
    (ENTRIES["OEM"], (700).to_bytes(2, "little"), b"", 0x1D),
    (ENTRIES["OEM after"], b"", bytes([700 & 0xFF]), 0x2F),
    (COUNTER_CRC8 + "data_id_bytes = 1\ndata_id = { Room = 255 }", b"\xff", b"", 0x1D),
]


@pytest.mark.parametrize(("entry", "before", "after", "polynomial"), CRCS)
def test_manufacturer_crc_covers_the_bytes_of_the_layout(
    protect: Callable[..., Protection], entry: str, before: bytes, after: bytes, polynomial: int
) -> None:
    protection = protect(entry)
    for frame in stream(protection, 20):
        assert frame[7] == crc8(before + frame[:7] + frame[8:] + after, polynomial)
    protection.counter.put(frame, 15)
    protection.seal(frame)
    is_code = protection.modulus == 16
    assert Receiver(protection).check(frame) is (Check.OK if is_code else Check.CORRUPT), "its CRC is right"


@pytest.mark.parametrize("first", [0, -1, -6, -8, -14])
def test_repeats_gaps_and_jumps_are_detected_across_counter_overflow(protection: Protection, first: int) -> None:
    frames = stream(protection, 17, first=protection.modulus + first)
    check = Receiver(protection).check
    found = [check(frames[k]) for k in (5, 5, 6, 9, 10, 14, 15, 16)]
    ok, jump = Check.OK, Check.JUMPED
    assert found == [ok, Check.REPEATED, ok, Check.LOST, ok, jump, ok, ok]


COUNTERS = [("P04", 0x0100), ("P04", 0x0101), ("P07", 0x0101), ("P07", 0x010001), ("P07", 0x01000000)]


@pytest.mark.parametrize(("kind", "counter"), COUNTERS)
def test_every_byte_of_a_multi_byte_counter_is_compared(protection: Protection, counter: int) -> None:
    check = Receiver(protection).check
    assert {check(frame) for frame in stream(protection, 13, first=-12)} == {Check.OK}, "the next counter is 1"
    assert check(*stream(protection, 1, first=counter)) is Check.JUMPED


# ---- the message as a whole


THIRD_OF_SIX = {"valid": (6, 1, 2), "invalid": (4, 3, 0)}
WINDOWS = {
    "corrupt frames are errors": (THIRD_OF_SIX, range(20), (12, 13, 14), "VVVVVVVVVVVVVVXXXXVV"),
    "lost frames are not errors": ({"init": (4, 3, 1), "valid": (4, 4, 0)}, range(0, 20, 2), (2,), "IIIVXVVVVV"),
    "repeated frames are not intact": ({"valid": (5, 1, 2)}, [0] * 6, (), "VVVVVX"),
    "too few frames for the next state": ({"valid": (6, 3, 0), "invalid": (6, 6, 0)}, range(9), (), "VXXXXVVVV"),
}
"""Window, `min_ok` and `max_error` by state; frames that are sent, those that are spoilt, and the states after each."""


@pytest.mark.parametrize(("windows", "sent", "spoilt", "states"), WINDOWS.values(), ids=WINDOWS)
def test_e2e_state_follows_the_windows_of_recent_frames(
    kind: str, protect: Callable[..., Protection], windows: Any, sent: Sequence[int], spoilt: Sequence[int], states: str
) -> None:
    """`sent` are places in a stream of frames; `states` has the state after each: initial, valid, or invalid (X)."""
    lines = [f"{key} = {{ window = {n}, min_ok = {ok}, max_error = {bad} }}" for key, (n, ok, bad) in windows.items()]
    protection = protect("\n".join([ENTRIES[kind], "max_delta_counter = 4", *lines]))
    receiver, frames, found = Receiver(protection), stream(protection, 20), ""
    for place in sent:
        receiver.check(damaged(frames[place]) if place in spoilt else frames[place])
        found += {E2EState.INIT: "I", E2EState.VALID: "V", E2EState.INVALID: "X"}[receiver.state]
    assert found == states


WINDOW = st.integers(1, 12).flatmap(  # a layout asks for no more intact frames than the window has
    lambda n: st.builds(E2EWindow, window=st.just(n), min_ok=st.integers(0, min(n, 6)), max_error=st.integers(0, 6))
)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    windows=st.tuples(WINDOW, WINDOW, WINDOW),
    steps=st.lists(st.sampled_from(("corrupt", 0, 1, 1, 1, 1, 2, 3, 4, 7)), max_size=60),
)
def test_checks_and_e2e_state_of_random_frames_follow_autosar(
    protection: Protection, windows: tuple[E2EWindow, E2EWindow, E2EWindow], steps: list[int | str]
) -> None:
    protection = replace(protection, windows=windows)
    receiver, payload, counter = Receiver(protection), bytearray(b"\xa5" * SIZE), protection.modulus - 9
    state, past = E2EState.INIT, list[Check]()
    for step in steps:
        if isinstance(step, str):
            wanted = Check.CORRUPT
        else:
            counter = (counter + step) % protection.modulus
            protection.counter.put(payload, counter)
            protection.seal(payload)
            is_first = all(check is Check.CORRUPT for check in past)
            by_step = {0: Check.REPEATED, 1: Check.OK, 2: Check.LOST, 3: Check.LOST}
            wanted = Check.OK if is_first else by_step.get(step, Check.JUMPED)
        assert receiver.check(payload if wanted is not Check.CORRUPT else damaged(payload)) is wanted
        if wanted is Check.CORRUPT and not past:
            continue
        past.append(wanted)
        window = windows[state]
        last = past[-window.window :]
        if last.count(Check.CORRUPT) > window.max_error:
            state = E2EState.INVALID
        elif last.count(Check.OK) + last.count(Check.LOST) >= window.min_ok:
            state = E2EState.VALID
        elif state is E2EState.VALID:
            state = E2EState.INVALID
        assert receiver.state is state


# ---- mistakes

HEADS = [("[e2e]", "[e2e]"), ('[[e2e]]\nprofile = "P01"\nmessages = ["Net"]\n[[e2e]]', "[[e2e]] entry number 2")]


MISTAKES = [
    (autosar("P99"), ", profile: expected one of P01, P02, P04, P05, P06, P07, P11, counter"),
    ('profile = "P01"\nmessages = ["Room", "Room"]', ", messages: Room is named twice"),
    (autosar("P01", "data_id = { Hall = 3 }"), ", data_id: Hall is not in 'messages'"),
    (autosar("P02", "data_id_list = {}"), ", data_id_list: Room has none"),
    (autosar("P05", 'crc = "C"'), ": unknown key 'crc'; allowed are profile, messages"),
    (autosar("P06", "data_id = { Room = 65536 }"), ", data_id, Room: "),
    (
        autosar("P01", 'data_id_mode = "nibble"\ndata_id = { Room = 4096 }'),
        ": message Room: data_id 4096 is above 4095",
    ),
    (autosar("P01", "max_delta_counter = 15"), ": message Room: max_delta_counter is 15"),
    (autosar("P06", "offset = 20"), ": message Room has 24 bytes, too few for the header of 25 bytes"),
    (OEM.replace('"Count"', '"Alive"'), ": message Room has no signal 'Alive'; it has Count, Sum"),
    (OEM.replace('crc = "Sum"', 'crc = "Count"'), ": message Room: signal Count must be one whole byte"),
    (OEM + "\ncounter_modulus = 17", ": message Room: signal Count cannot count from 0 to 16"),
    (OEM + '\nalgorithm = "md5"', ": message Room: algorithm 'md5' is not known; known are autosar, bluetooth,"),
    (COUNTER_CRC8 + "data_id_bytes = 1\ndata_id = { Room = 256 }", "256 does not fit into data_id_bytes = 1"),
]


@pytest.mark.parametrize(("entry", "words"), MISTAKES)
@pytest.mark.parametrize(("head", "place"), HEADS)
def test_mistake_in_an_e2e_entry_is_refused_with_its_place(
    protect: Callable[..., Protection], head: str, place: str, entry: str, words: str
) -> None:
    with pytest.raises(LayoutError, match=rf"small\.toml: {re.escape(place)}.*{re.escape(words)}") as caught:
        protect(entry, head=head)
    assert "\n" not in str(caught.value)


UNFIT = [
    (ENTRIES["P01"], "Room: 24", "Room: 10", "10 bytes in the DBC; CAN FD pads it, .* 12, 16, 20, 24, 32,"),
    (OEM, "56|8@1+", "57|8@1+", "signal Sum must be one whole byte to be a CRC-8$"),
    (OEM, "36|4@1+", "38|4@1+", "signal Count must be within one byte to be a counter$"),
    (OEM, "36|4@1+", "36|4@1-", "signal Count cannot count from 0 to 7$"),
    (OEM, "SG_ Sum", "SG_ Count", "has several signals named 'Count'; rename all but one in the DBC$"),
]


@pytest.mark.parametrize(("entry", "old", "new", "words"), UNFIT)
def test_message_that_cannot_carry_its_protection_is_refused(
    protect: Callable[..., Protection], entry: str, old: str, new: str, words: str
) -> None:
    with pytest.raises(LayoutError, match=f"message Room.* {words}"):
        protect(entry, room=ROOM.replace(old, new))


def test_messages_may_have_different_protections_but_only_one_each(make_database: MakeDatabase) -> None:
    dbc = SMALL_DBC.replace("VAL_", ROOM + "VAL_", 1)
    entries = f'\n[[e2e]]\n{ENTRIES["P05"]}\n\n[[e2e]]\nprofile = "P01"\nmessages = ["Net", "Heater"]\n'
    database = make_database(SMALL_LAYOUT + entries, dbc)
    found = {name: protection_of(database, database.message(name)) for name in ("Room", "Net", "Pair")}
    assert {name: item and item.modulus for name, item in found.items()} == {"Room": 256, "Net": 15, "Pair": None}
    words = r"\[\[e2e\]\] entry number 2, messages: Room stands in \[\[e2e\]\] entry number 1 too"
    with pytest.raises(LayoutError, match=words):
        make_database(SMALL_LAYOUT + entries.replace("Net", "Room"), dbc)
