"""The fuzz test of the node at small size, and that it would see what it looks for."""

from random import Random

import pytest

from bench import node_fuzz
from bench.node_fuzz import WrongFrameError, fuzz
from bench.node_fuzz_oracle import FuzzFrame
from bench.node_fuzz_vehicles import FuzzSignal, draw_vehicle


@pytest.mark.long
def test_twenty_thousand_frames_are_right_in_both_modes() -> None:
    assert list(fuzz(20_000, seed=1, frames_per_vehicle=2_000))[-1] == 20_000


def test_the_same_seed_draws_the_same_frames() -> None:
    vehicles = [draw_vehicle(Random("seed")) for _ in range(2)]
    first, second = (list(node_fuzz._frames(Random(1), vehicle, 100)) for vehicle in vehicles)
    assert first == second


def test_a_wrong_bit_is_reported_with_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    send = node_fuzz._ScriptedBus.send

    def damaged(bus: node_fuzz._ScriptedBus, msg: object) -> None:
        send(bus, msg)  # type: ignore[arg-type]
        last = bus._sent[-1][-1]
        if last.data:
            bus._sent[-1][-1] = last._replace(data=bytes((last.data[0] ^ 1, *last.data[1:])))

    monkeypatch.setattr(node_fuzz._ScriptedBus, "send", damaged)
    with pytest.raises(WrongFrameError, match=r"seed 0, vehicle of frame 0, .*, frame \d+: .*#[0-9A-F]* .* -> "):
        list(fuzz(500, seed=0))


def test_bits_of_a_signal_are_those_of_the_dbc() -> None:
    signal = FuzzSignal(name="S", bits=(7, 6, 5, 4, 3, 2, 1, 0, 15, 14), big=True, signed=True)
    payload = bytearray(2)
    signal.put(payload, -2)
    assert (payload.hex(), signal.code(bytes(payload))) == ("ff80", -2)
    assert signal.text() == ' SG_ S : 7|10@0- (1,0) [0|0] "" X'


def test_frames_are_told_in_hex() -> None:
    assert FuzzFrame(0x12, extended=True, data=b"\xab", dlc=1).text() == "00000012#AB (dlc 1)"
