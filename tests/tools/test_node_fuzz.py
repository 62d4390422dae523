"""The fuzz test of the node at small size, and that it would see what it looks for."""

import pytest

from bench.node_fuzz import WrongFrameError, fuzz
from ecu_node.core.corrector import Source


def test_random_frames_are_right_in_both_modes() -> None:
    assert list(fuzz(1_500, seed=2, frames_per_vehicle=500))[-1] == 1_500


@pytest.mark.long
def test_frames_of_many_random_vehicles_are_right_in_both_modes() -> None:
    assert list(fuzz(40_000, seed=1, frames_per_vehicle=1_000))[-1] == 40_000


@pytest.mark.parametrize(("mode", "method"), [("overlay", "answer"), ("gateway", "forward")])
def test_a_wrong_bit_is_reported_with_its_frame(monkeypatch: pytest.MonkeyPatch, mode: str, method: str) -> None:
    right = getattr(Source, method)

    def damaged(source: Source, payload: bytearray, now_s: float) -> object:
        made = right(source, payload, now_s)
        for item in [made] if isinstance(made, bytearray) else [target.data for target in made or ()]:
            item[0] ^= 1
        return made

    monkeypatch.setattr(Source, method, damaged)
    with pytest.raises(WrongFrameError, match=rf"seed 0, vehicle of frame 0, {mode}, frame \d+: .* -> .*#.*: "):
        list(fuzz(500, seed=0))
