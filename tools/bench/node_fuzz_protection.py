"""End-to-end protection for the node's fuzz test, by autosar-e2e and fastcrc themselves."""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random

import fastcrc
from e2e import p01, p02, p05

__all__ = ["CheckState", "FuzzProtection", "draw_protection"]


@dataclass(frozen=True, kw_only=True)
class FuzzProtection:
    """How the frames of one message are protected.

    Attributes
    ----------
    mask : int
        Bits of the header in the payload read as a little-endian integer.
    least : int
        Bytes that a frame needs.
    modulus : int
        Codes of the counter.
    counter_byte, counter_shift, counter_ones : int
        Where the counter stands.
    max_step : int
        Largest step of the counter that is used.
    sound, seal : callable
        Whether the CRC is right; writes it.
    toml : str
        Its part of the layout; "%" stands for the name of the message.
    dbc_lines : tuple of str
        Its signals in the DBC.
    """

    mask: int
    least: int
    modulus: int
    counter_byte: int
    counter_shift: int = 0
    counter_ones: int
    max_step: int
    sound: Callable[[bytearray], bool]
    seal: Callable[[bytearray], None]
    toml: str
    dbc_lines: tuple[str, ...] = ()

    def counter(self, payload: bytes | bytearray) -> int:
        """The counter of a payload."""
        return payload[self.counter_byte] >> self.counter_shift & self.counter_ones

    def protect(self, payload: bytearray, counter: int) -> None:
        """Write counter and CRC."""
        cleared = payload[self.counter_byte] & ~(self.counter_ones << self.counter_shift)
        payload[self.counter_byte] = cleared | counter << self.counter_shift
        self.seal(payload)


class CheckState:
    """What a receiver remembers of one message."""

    def __init__(self, protection: FuzzProtection | None) -> None:
        self._protection = protection
        self._last: int | None = None

    def take(self, payload: bytes) -> str:
        """Look at a frame: "usable", "corrupt", or intact but "out of order"."""
        protection = self._protection
        if protection is None:
            return "usable"
        if len(payload) < protection.least or not protection.sound(bytearray(payload)):
            return "corrupt"
        counter, last = protection.counter(payload), self._last
        if counter >= protection.modulus:
            return "corrupt"
        self._last = counter
        if last is None:
            return "usable"
        return "usable" if 1 <= (counter - last) % protection.modulus <= protection.max_step else "out of order"


def draw_protection(rng: Random, identifier: int, size: int) -> FuzzProtection | None:
    """Draw a profile that fits a message; None if it is too short for it."""
    draw = rng.choice((_draw_p01, _draw_p01, _draw_p02, _draw_p05, _draw_counter_crc8))
    found = draw(rng, identifier & 0xFFFF, size, rng.randint(1, 4))
    return found if found is not None and found.least < size else None


def _draw_p01(rng: Random, data_id: int, size: int, step: int) -> FuzzProtection | None:
    modes = {
        "both": p01.E2E_P01_DATAID_BOTH,
        "alternating": p01.E2E_P01_DATAID_ALT,
        "low": p01.E2E_P01_DATAID_LOW,
        "nibble": p01.E2E_P01_DATAID_NIBBLE,
    }
    name = rng.choice(("both", *modes))
    mode, offset = modes[name], rng.choice((0, 0, 0, min(max(size - 3, 0), 5)))
    return FuzzProtection(
        mask=(0xFFFF if name == "nibble" else 0xFFF) << 8 * offset,
        least=offset + 2,
        modulus=15,
        counter_byte=offset + 1,
        counter_ones=15,
        max_step=step,
        sound=lambda data: p01.e2e_p01_check(data, data_id, data_id_mode=mode, offset=offset),
        seal=lambda data: p01.e2e_p01_protect(data, data_id, data_id_mode=mode, offset=offset, increment_counter=False),
        toml=f'profile = "P01"\ndata_id_mode = "{name}"\noffset = {offset}\nmax_delta_counter = {step}',
    )


def _draw_p02(rng: Random, data_id: int, size: int, step: int) -> FuzzProtection | None:  # noqa: ARG001 (all take the same)
    numbers = rng.randbytes(16)
    return FuzzProtection(
        mask=0xFFF,
        least=2,
        modulus=16,
        counter_byte=1,
        counter_ones=15,
        max_step=step,
        sound=lambda data: p02.e2e_p02_check(data, numbers, length=len(data)),
        seal=lambda data: p02.e2e_p02_protect(data, numbers, increment_counter=False),
        toml=f'profile = "P02"\nmax_delta_counter = {step}\ndata_id_list = {{ "%" = {list(numbers)} }}',
    )


def _draw_p05(rng: Random, data_id: int, size: int, step: int) -> FuzzProtection | None:
    offset = rng.choice((0, 0, min(max(size - 4, 0), 6)))
    return FuzzProtection(
        mask=0xFFFFFF << 8 * offset,
        least=offset + 3,
        modulus=256,
        counter_byte=offset + 2,
        counter_ones=255,
        max_step=step,
        sound=lambda data: p05.e2e_p05_check(data, data_id, offset=offset),
        seal=lambda data: p05.e2e_p05_protect(data, data_id, offset=offset, increment_counter=False),
        toml=f'profile = "P05"\noffset = {offset}\nmax_delta_counter = {step}',
    )


def _draw_counter_crc8(rng: Random, data_id: int, size: int, step: int) -> FuzzProtection | None:
    if size < 3:
        return None
    byte, counter_byte = rng.sample(range(min(size, 4)), 2)
    shift, bytes_of_id, place = rng.choice((0, 3, 4)), rng.choice((0, 1, 2)), rng.choice(("before", "after"))
    modulus, algorithm = rng.choice((15, 16)), rng.choice(("sae_j1850", "autosar"))
    crc8 = getattr(fastcrc.crc8, algorithm)
    identity = data_id.to_bytes(2, "little")[:bytes_of_id]

    def crc(data: bytearray) -> int:
        rest = bytes(data[:byte]) + bytes(data[byte + 1 :])
        return int(crc8(identity + rest if place == "before" else rest + identity))

    def seal(data: bytearray) -> None:
        data[byte] = crc(data)

    return FuzzProtection(
        mask=0xFF << 8 * byte | 0xF << (8 * counter_byte + shift),
        least=max(byte, counter_byte) + 1,
        modulus=modulus,
        counter_byte=counter_byte,
        counter_shift=shift,
        counter_ones=15,
        max_step=step,
        sound=lambda data: data[byte] == crc(data),
        seal=seal,
        toml=(
            f'profile = "counter CRC8"\ncounter = "Counter"\ncrc = "Crc"\nalgorithm = "{algorithm}"\n'
            f"counter_modulus = {modulus}\ndata_id_bytes = {bytes_of_id}\ndata_id_at = "
            f'"{place}"\nmax_delta_counter = {step}'
        ),
        dbc_lines=(
            f' SG_ Crc : {8 * byte}|8@1+ (1,0) [0|0] "" X',
            f' SG_ Counter : {8 * counter_byte + shift}|4@1+ (1,0) [0|0] "" X',
        ),
    )
