"""End-to-end protection: what is accepted, what is counted out; the libraries find the frames sound."""

from collections.abc import Callable

import fastcrc
import pytest

from ecu_node.core.e2e import Check, E2EState, Protection, Receiver, protection_of
from ecu_node.errors import DatabaseError, LayoutError
from tests.ecu_node.vehicles import SMALL_DBC, SMALL_LAYOUT, MakeDatabase

SIZE = 24
ROOM = (
    f'BO_ 700 Room: {SIZE} Node\n SG_ Count : 36|4@1+ (1,0) [0|15] "" Node\n SG_ Sum : 56|8@1+ (1,0) [0|255] "" Node\n'
)
LIST = list(range(100, 116))
ENTRIES = {
    "P01": 'profile = "P01"\nmessages = ["Room"]\ndata_id = { Room = 0x1234 }',
    "P01 alternating": 'profile = "P01"\nmessages = ["Room"]\ndata_id_mode = "alternating"',
    "P01 low": 'profile = "P01"\nmessages = ["Room"]\ndata_id_mode = "low"',
    "P01 further on": 'profile = "P01"\nmessages = ["Room"]\noffset = 1',
    "P01 nibble": 'profile = "P01"\nmessages = ["Room"]\ndata_id_mode = "nibble"\noffset = 3',
    "P02": f'profile = "P02"\nmessages = ["Room"]\ndata_id_list = {{ Room = {LIST} }}',
    "P04": 'profile = "P04"\nmessages = ["Room"]\ndata_id = { Room = 0x0A0B0C0D }',
    "P04 further on": 'profile = "P04"\nmessages = ["Room"]\noffset = 5',
    "P05": 'profile = "P05"\nmessages = ["Room"]\noffset = 2',
    "P06": 'profile = "P06"\nmessages = ["Room"]\ndata_id = { Room = 0x1234 }',
    "P06 further on": 'profile = "P06"\nmessages = ["Room"]\noffset = 3',
    "P07": 'profile = "P07"\nmessages = ["Room"]\ndata_id = { Room = 0x0A0B0C0D }',
    "P07 further on": 'profile = "P07"\nmessages = ["Room"]\noffset = 3',
    "P11": 'profile = "P11"\nmessages = ["Room"]\ndata_id = { Room = 0x123 }',
    "P11 nibble": 'profile = "P11"\nmessages = ["Room"]\ndata_id_mode = "nibble"\noffset = 4',
    "OEM": 'profile = "counter CRC8"\nmessages = ["Room"]\ncounter = "Count"\ncrc = "Sum"\ndata_id_bytes = 2',
    "OEM after": 'profile = "counter CRC8"\nmessages = ["Room"]\ncounter = "Count"\ncrc = "Sum"\ncounter_modulus = 15\n'
    'algorithm = "autosar"\ndata_id_bytes = 1\ndata_id_at = "after"',
}
OEM = ENTRIES["OEM"]
MODULUS = {"P02": 16, "P04": 1 << 16, "P05": 256, "P06": 256, "P07": 1 << 32, "OEM": 16}
HEADERS = {
    "P01": "ff0f",
    "P01 alternating": "ff0f",
    "P01 low": "ff0f",
    "P01 further on": "00ff0f",
    "P01 nibble": "000000ffff",
    "P02": "ff0f",
    "P04": "ff" * 12,
    "P04 further on": "00" * 5 + "ff" * 12,
    "P05": "0000ffffff",
    "P06": "ff" * 5,
    "P06 further on": "00" * 3 + "ff" * 5,
    "P07": "ff" * 20,
    "P07 further on": "00" * 3 + "ff" * 20,
    "P11": "ff0f",
    "P11 nibble": "00000000ffff",
    "OEM": "00000000f00000ff",
    "OEM after": "00000000f00000ff",
}
"""The bits that the profile writes, in the payload."""


@pytest.fixture(params=list(ENTRIES))
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def protect(make_database: MakeDatabase) -> Callable[[str], Protection]:
    def make(entry: str) -> Protection:
        database = make_database(f"{SMALL_LAYOUT}\n[e2e]\n{entry}\n", SMALL_DBC.replace("VAL_", ROOM + "VAL_", 1))
        protection = protection_of(database, database.message("Room"))
        assert protection is not None
        return protection

    return make


def stream(protection: Protection, count: int, size: int = SIZE, *, first: int = 0) -> list[bytearray]:
    """Frames in order, the first one with this counter."""
    payload = bytearray(b"\xa5" * size)
    protection.counter.put(payload, (first - 1) % protection.modulus)
    frames = []
    for _ in range(count):
        protection.advance(payload)
        frames.append(bytearray(payload))
    return frames


def test_the_counter_starts_at_0_runs_through_and_every_frame_in_order_is_ok(
    kind: str, protect: Callable[[str], Protection]
) -> None:
    protection = protect(ENTRIES[kind])
    frames = stream(protection, 300)
    modulus = MODULUS.get(kind.partition(" ")[0] if kind != "OEM after" else kind, 15)
    assert protection.modulus == modulus
    assert [protection.counter_of(frame) for frame in frames] == [k % modulus for k in range(300)]
    check = Receiver(protection).check
    assert {check(frame) for frame in frames} == {Check.OK}


def test_the_header_is_crc_and_counter_and_no_bit_more(kind: str, protect: Callable[[str], Protection]) -> None:
    assert protect(ENTRIES[kind]).header_mask == int.from_bytes(bytes.fromhex(HEADERS[kind]), "little")


def test_sealing_keeps_the_counter(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    for frame in stream(protection, 20):
        before = protection.counter_of(frame)
        frame[-1] ^= 0xFF
        assert not protection.is_sound(frame)
        protection.seal(frame)
        assert protection.is_sound(frame)
        assert protection.counter_of(frame) == before


def test_any_flipped_bit_is_noticed(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    (frame,) = stream(protection, 1)
    for bit in range(8 * SIZE):
        damaged = bytearray((int.from_bytes(frame, "little") ^ 1 << bit).to_bytes(SIZE, "little"))
        assert Receiver(protection).check(damaged) is Check.CORRUPT


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (ENTRIES["P04"], "001000000a0b0c0d862b055600000000"),
        (ENTRIES["P05"].replace("offset = 2", "data_id = { Room = 0x1234 }"), "1cca000000000000"),
        (ENTRIES["P06"], "b155000800000000"),
        (ENTRIES["P07"], "1fb2e737fcedbcd900000018000000000a0b0c0d00000000"),
        (ENTRIES["P11"], "cc00000000000000"),
        (ENTRIES["P11"] + '\ndata_id_mode = "nibble"', "2a10000000000000"),
    ],
)
def test_first_frame_is_that_of_the_examples_of_autosar(
    protect: Callable[[str], Protection], entry: str, expected: str
) -> None:
    payload = bytearray(len(bytes.fromhex(expected)))
    protection = protect(entry)
    protection.before_first(payload)
    protection.advance(payload)
    assert payload.hex() == expected


@pytest.mark.parametrize("profile", ["P04", "P07"])
def test_data_identifier_of_29_bits_is_the_identifier_of_the_message(make_database: MakeDatabase, profile: str) -> None:
    dbc = SMALL_DBC.replace("BO_ 2147484160 Heater: 4", f"BO_ {0x80000000 | 0x12345678} Heater: 32")
    layout = f'{SMALL_LAYOUT}\n[e2e]\nprofile = "{profile}"\nmessages = ["Heater"]\noffset = 3\n'
    database = make_database(layout, dbc)
    protection = protection_of(database, database.message("Heater"))
    assert protection is not None
    (frame,) = stream(protection, 1)
    assert bytes.fromhex("12345678") in frame


def crc8(data: bytes, polynomial: int) -> int:
    """CRC-8 with start and final value 0xFF, bit by bit."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (polynomial if crc & 0x80 else 0)) & 0xFF
    return crc ^ 0xFF


def test_the_crc_of_a_control_unit_is_what_its_words_say(protect: Callable[[str], Protection]) -> None:
    for frame in stream(protect(ENTRIES["OEM"]), 20):
        assert frame[7] == crc8((700).to_bytes(2, "little") + frame[:7] + frame[8:], 0x1D)
    for frame in stream(protect(ENTRIES["OEM after"]), 20):
        assert frame[7] == crc8(bytes(frame[:7] + frame[8:]) + bytes([700 & 0xFF]), 0x2F)


def test_a_frame_without_room_for_the_header_is_corrupt(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    assert {Receiver(protection).check(bytearray(size)) for size in range(protection.least_bytes)} == {Check.CORRUPT}


def test_a_code_beyond_those_of_the_counter_is_corrupt_though_its_crc_is_right(
    protect: Callable[[str], Protection],
) -> None:
    protection = protect(ENTRIES["OEM after"])
    (frame,) = stream(protection, 1)
    protection.counter.put(frame, 15)
    protection.seal(frame)
    assert protection.is_sound(frame)
    assert Receiver(protection).check(frame) is Check.CORRUPT


def test_repeated_frames_gaps_and_jumps(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind] + "\nmax_delta_counter = 3")
    frames = stream(protection, 20)
    check = Receiver(protection).check
    found = [check(frames[k]) for k in (5, 5, 6, 9, 10, 14, 15, 16)]
    ok, jump = Check.OK, Check.JUMPED
    assert found == [ok, Check.REPEATED, ok, Check.LOST, ok, jump, ok, ok]


@pytest.mark.parametrize(
    ("kind", "counter"), [("P04", 0x0100), ("P04", 0x0101), ("P07", 0x0101), ("P07", 0x010001), ("P07", 0x01000000)]
)
def test_every_byte_of_a_long_counter_is_compared_with_the_next_one(
    protect: Callable[[str], Protection], kind: str, counter: int
) -> None:
    protection = protect(ENTRIES[kind])
    check = Receiver(protection).check
    assert {check(frame) for frame in stream(protection, 13, first=-12)} == {Check.OK}, "the next counter is 1"
    assert check(*stream(protection, 1, first=counter)) is Check.JUMPED


def damaged(frame: bytearray) -> bytearray:
    return frame[:-1] + bytes([frame[-1] ^ 1])


def test_more_corrupt_frames_than_allowed_make_a_message_invalid_until_enough_are_intact(
    kind: str, protect: Callable[[str], Protection]
) -> None:
    windows = "valid = { window = 6, min_ok = 1, max_error = 2 }\ninvalid = { window = 4, min_ok = 3, max_error = 0 }"
    protection = protect(f"{ENTRIES[kind]}\nmax_delta_counter = 4\n{windows}")
    receiver, frames, states = Receiver(protection), stream(protection, 40), []
    for number, frame in enumerate(frames[:20]):
        receiver.check(damaged(frame) if number in {12, 13, 14} else frame)
        states.append(receiver.state)
    invalid = [number for number, state in enumerate(states) if state is E2EState.INVALID]
    assert invalid == [14, 15, 16, 17], "the third error of six; four frames without one make it valid again"


def test_after_a_silence_a_single_frame_with_any_counter_is_not_enough(
    kind: str, protect: Callable[[str], Protection]
) -> None:
    protection = protect(ENTRIES[kind])
    receiver, frames = Receiver(protection), stream(protection, 40)
    for frame in frames[:12]:
        receiver.check(frame)
    receiver.restart()
    states = []
    for frame in frames[5:8]:
        assert receiver.check(frame) is Check.OK
        states.append(receiver.state)
    assert states == [E2EState.INVALID, E2EState.INVALID, E2EState.VALID]


def test_a_corrupt_frame_leaves_the_counter_as_it_was(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    frames = stream(protection, 3)
    check = Receiver(protection).check
    check(frames[0])
    damaged = bytearray(frames[1])
    damaged[-1] ^= 1
    assert check(damaged) is Check.CORRUPT
    assert check(frames[1]) is Check.OK


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (
            ENTRIES["P01"].replace("Room", "Net") + "\noffset = 1",
            "message Net has 2 bytes, too few for the header of 3",
        ),
        (
            ENTRIES["P04"].replace("Room", "Net"),
            r"^.*: \[e2e\]: message Net has 2 bytes, too few for the header of 12 bytes$",
        ),
        (ENTRIES["P06"] + "\noffset = 20", "message Room has 24 bytes, too few for the header of 25 bytes$"),
        (ENTRIES["P07"] + "\noffset = 5", "message Room has 24 bytes, too few for the header of 25 bytes$"),
        (OEM.replace('"Count"', '"Alive"'), r"message Room has no signal 'Alive'; it has Count, Sum"),
        (OEM.replace('crc = "Sum"', 'crc = "Count"'), "signal Count must be one whole byte"),
        (OEM + "\ncounter_modulus = 17", "signal Count cannot count from 0 to 16"),
        (OEM + '\nalgorithm = "md5"', "message Room: algorithm 'md5' is not known; known are autosar, bluetooth,"),
        (
            OEM.replace("data_id_bytes = 2", "data_id_bytes = 1\ndata_id = { Room = 256 }"),
            "data_id 256 does not fit into",
        ),
        (OEM.replace("data_id_bytes = 2", "data_id = { Room = 5 }"), "data_id 5 does not fit into data_id_bytes = 0"),
    ],
)
def test_protection_that_cannot_be_is_one_line(make_database: MakeDatabase, entry: str, words: str) -> None:
    dbc = SMALL_DBC.replace("VAL_", ROOM + "VAL_", 1)
    with pytest.raises(LayoutError, match=words) as caught:  # noqa: PT012  # either of the two may find it
        database = make_database(f"{SMALL_LAYOUT}\n[e2e]\n{entry}\n", dbc)
        for name in ("Room", "Net"):
            protection_of(database, database.message(name))
    assert "\n" not in str(caught.value)


def test_a_message_that_can_fd_pads_cannot_be_protected(make_database: MakeDatabase) -> None:
    dbc = SMALL_DBC.replace("VAL_", ROOM.replace("Room: 24", "Room: 10") + "VAL_", 1)
    database = make_database(f"{SMALL_LAYOUT}\n[e2e]\n{ENTRIES['P01']}\n", dbc)
    words = "message Room has 10 bytes in the DBC; CAN FD pads it, .* expected 12, 16, 20, 24, 32, 48, 64$"
    with pytest.raises(LayoutError, match=words):
        protection_of(database, database.message("Room"))


WRONG = [
    ('profile = "P99"\nmessages = ["Room"]', ", profile: expected one of P01, P02, P04, P05, P06, P07, P11, counter"),
    ('profile = "P01"', ": 'messages' is missing"),
    ('profile = "P01"\nmessages = ["Room", "Room"]', ", messages: Room is named twice"),
    ('profile = "P01"\nmessages = ["Room"]\ndata_id = { Hall = 3 }', ", data_id: Hall is not in 'messages'"),
    ('profile = "P02"\nmessages = ["Room"]\ndata_id_list = {}', ", data_id_list: Room has none"),
    ('profile = "P05"\nmessages = ["Room"]\ncrc = "C"', ": unknown key 'crc'; allowed are profile, messages"),
    ('profile = "P06"\nmessages = ["Room"]\ndata_id = { Room = 65536 }', ", data_id, Room: "),
    ('profile = "P01"\nmessages = ["Room"]\nmax_delta_counter = 15', ": message Room: max_delta_counter is 15"),
]
HEADS = [("[e2e]", "[e2e]"), ('[[e2e]]\nprofile = "P01"\nmessages = ["Net"]\n[[e2e]]', "[[e2e]] entry number 2")]


@pytest.mark.parametrize(("entry", "words"), WRONG)
@pytest.mark.parametrize(("head", "place"), HEADS)
def test_a_wrong_entry_is_named_by_its_place_as_it_was_written(
    make_database: MakeDatabase, head: str, place: str, entry: str, words: str
) -> None:
    with pytest.raises(LayoutError, match=r"small\.toml: ") as caught:  # noqa: PT012  # either of the two may find it
        database = make_database(f"{SMALL_LAYOUT}\n{head}\n{entry}\n", SMALL_DBC.replace("VAL_", ROOM + "VAL_", 1))
        protection_of(database, database.message("Room"))
    assert f"{place}{words}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_the_header_is_written(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    for frame in stream(protection, 20):
        changed = int.from_bytes(frame, "little") ^ int.from_bytes(b"\xa5" * SIZE, "little")
        assert changed & ~protection.header_mask == 0


def test_wrong_length_or_data_identifier_is_corrupt_though_the_crc_is_right(
    protect: Callable[[str], Protection],
) -> None:
    def is_intact(kind: str, changed: int, crc: Callable[[bytearray], bytes], crc_at: int) -> bool:
        (frame,) = stream(protect(ENTRIES[kind]), 1)
        frame[changed] ^= 0x10
        made = crc(frame)
        frame[crc_at : crc_at + len(made)] = made
        return protect(ENTRIES[kind]).is_sound(frame)

    def crc32(frame: bytearray) -> bytes:
        return fastcrc.crc32.autosar(bytes(frame[:8] + frame[12:])).to_bytes(4)

    def crc16(frame: bytearray) -> bytes:
        return fastcrc.crc16.ibm_3740(bytes(frame[2:]) + b"\x12\x34").to_bytes(2)

    def crc64(frame: bytearray) -> bytes:
        return fastcrc.crc64.xz(bytes(frame[8:])).to_bytes(8)

    def crc8_nibble(frame: bytearray) -> bytes:
        return fastcrc.crc8.gsm_a(bytes([700 & 0xFF, 0]) + bytes(frame[:4] + frame[5:])).to_bytes(1)

    length, counter, identity, content = 1, 3, 7, 20
    assert [is_intact("P04", byte, crc32, 8) for byte in (length, identity, counter, content)] == [False] * 2 + [
        True
    ] * 2
    assert [is_intact("P06", byte, crc16, 0) for byte in (3, 4, content)] == [False, True, True]
    assert [is_intact("P07", byte, crc64, 0) for byte in (11, 19, 15, content)] == [False] * 2 + [True] * 2
    assert [is_intact("P11 nibble", byte, crc8_nibble, 4) for byte in (5, content)] == [False, True]


def test_the_largest_data_identifier_of_a_byte_is_covered(protect: Callable[[str], Protection]) -> None:
    entry = OEM.replace("data_id_bytes = 2", "data_id_bytes = 1\ndata_id = { Room = 255 }")
    (frame,) = stream(protect(entry), 1)
    assert frame[7] == crc8(b"\xff" + frame[:7] + frame[8:], 0x1D)


def test_a_frame_that_is_all_header_is_read(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    (frame,) = stream(protection, 1, size=len(bytes.fromhex(HEADERS[kind])))
    assert Receiver(protection).check(frame) is Check.OK


@pytest.mark.parametrize("last", [-1, 0])
def test_gaps_and_jumps_count_on_past_the_last_code(kind: str, protect: Callable[[str], Protection], last: int) -> None:
    protection = protect(ENTRIES[kind] + "\nmax_delta_counter = 3")
    last += protection.modulus
    frames = stream(protection, 9, first=last)
    for step, found in ((0, Check.REPEATED), (1, Check.OK), (3, Check.LOST), (4, Check.JUMPED), (8, Check.JUMPED)):
        check = Receiver(protection).check
        assert [check(frames[0]), check(frames[step])] == [Check.OK, found]


def test_message_is_valid_from_its_first_intact_frame(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind])
    receiver, frame, states = Receiver(protection), stream(protection, 1)[0], []
    for payload in (damaged(frame), frame):
        receiver.check(payload)
        states.append(receiver.state)
    assert states == [E2EState.INIT, E2EState.VALID]


def test_repeated_frames_are_no_intact_ones(kind: str, protect: Callable[[str], Protection]) -> None:
    protection = protect(ENTRIES[kind] + "\nvalid = { window = 5, min_ok = 1, max_error = 2 }")
    receiver = Receiver(protection)
    frame = stream(protection, 1)[0]
    states = [receiver.check(frame) and receiver.state for _ in range(6)]
    assert states[1:] == [E2EState.VALID] * 4 + [E2EState.INVALID]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("56|8@1+", "57|8@1+", "message Room: signal Sum must be one whole byte to be a CRC-8$"),
        ("56|8@1+", "56|7@1+", "message Room: signal Sum must be one whole byte to be a CRC-8$"),
        ("36|4@1+", "38|4@1+", "message Room: signal Count must be within one byte to be a counter$"),
        ("36|4@1+", "36|4@1-", "message Room: signal Count cannot count from 0 to 7$"),
    ],
)
def test_signals_that_can_be_no_counter_or_crc_are_refused(
    make_database: MakeDatabase, old: str, new: str, words: str
) -> None:
    dbc = SMALL_DBC.replace("VAL_", ROOM.replace(old, new) + "VAL_", 1)
    database = make_database(f"{SMALL_LAYOUT}\n[e2e]\n{OEM}\n", dbc)
    with pytest.raises(LayoutError, match=words):
        protection_of(database, database.message("Room"))


def test_a_message_has_one_protection(make_database: MakeDatabase) -> None:
    twice = "".join(f"\n[[e2e]]\n{ENTRIES[kind]}\n" for kind in ("P01", "P05"))
    words = r"\[\[e2e\]\] entry number 2, messages: Room stands in \[\[e2e\]\] entry number 1 too"
    with pytest.raises(LayoutError, match=words):
        make_database(SMALL_LAYOUT + twice, SMALL_DBC.replace("VAL_", ROOM + "VAL_", 1))


def test_messages_may_be_protected_in_different_ways(make_database: MakeDatabase) -> None:
    entries = f'\n[[e2e]]\n{ENTRIES["P05"]}\n\n[[e2e]]\nprofile = "P01"\nmessages = ["Net", "Heater"]\n'
    database = make_database(SMALL_LAYOUT + entries, SMALL_DBC.replace("VAL_", ROOM + "VAL_", 1))
    found = {name: protection_of(database, database.message(name)) for name in ("Room", "Net", "Pair")}
    assert {name: item and item.modulus for name, item in found.items()} == {"Room": 256, "Net": 15, "Pair": None}


@pytest.mark.parametrize(("head", "place"), HEADS)
def test_a_protected_message_that_the_dbc_lacks_is_named_with_its_place(
    make_database: MakeDatabase, head: str, place: str
) -> None:
    with pytest.raises(DatabaseError, match="no message 'Nobody', which") as caught:
        make_database(f'{SMALL_LAYOUT}\n{head}\nprofile = "P01"\nmessages = ["Nobody"]\n')
    assert str(caught.value).endswith(f"small.toml names in {place}")
