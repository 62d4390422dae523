"""End-to-end protection for the node's fuzz test: profiles and state machine as AUTOSAR defines them, CRCs by fastcrc.

See AUTOSAR Foundation, E2E Protocol Specification (PRS_E2EProtocol). Nothing here is the node's, or autosar-e2e's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import NamedTuple

from fastcrc import crc8, crc16, crc32, crc64

__all__ = ["CheckState", "FuzzProtection", "Window", "draw_protection"]


class Window(NamedTuple):
    """What makes a message valid in one state of it."""

    window: int
    min_ok: int
    max_error: int


_ALWAYS_VALID = (Window(1, 0, 1),) * 3


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
    counter_byte, counter_bytes, counter_shift, counter_ones : int
        Where the counter stands, the most significant byte first.
    max_step : int
        Largest step of the counter that is used.
    write_fields : callable
        Writes length and data identifier.
    crc : callable
        CRC of a payload, as it is written.
    crc_byte : int
        Where it begins.
    toml : str
        Its part of the layout; "%" stands for the name of the message.
    dbc_lines : tuple of str
        Its signals in the DBC.
    windows : tuple of Window
        In the states INIT, VALID and INVALID.
    """

    mask: int
    least: int
    modulus: int
    counter_byte: int
    counter_bytes: int = 1
    counter_shift: int = 0
    counter_ones: int
    max_step: int
    write_fields: Callable[[bytearray], None] = lambda _: None
    crc: Callable[[bytes], bytes]
    crc_byte: int
    toml: str
    dbc_lines: tuple[str, ...] = ()
    windows: tuple[Window, ...]

    def counter(self, payload: bytes | bytearray) -> int:
        """The counter of a payload."""
        field = payload[self.counter_byte : self.counter_byte + self.counter_bytes]
        return int.from_bytes(field, "big") >> self.counter_shift & self.counter_ones

    def sound(self, payload: bytes | bytearray) -> bool:
        """Whether CRC, length and data identifier are right."""
        expected = bytearray(payload)
        self.write_fields(expected)
        self.write_crc(expected)
        return expected == payload

    def protect(self, payload: bytearray, counter: int) -> None:
        """Write counter, length, data identifier and CRC."""
        place = slice(self.counter_byte, self.counter_byte + self.counter_bytes)
        cleared = int.from_bytes(payload[place], "big") & ~(self.counter_ones << self.counter_shift)
        payload[place] = (cleared | counter << self.counter_shift).to_bytes(self.counter_bytes, "big")
        self.write_fields(payload)
        self.write_crc(payload)

    def write_crc(self, payload: bytearray) -> None:
        """Write the CRC; all else stays."""
        crc = self.crc(bytes(payload))
        payload[self.crc_byte : self.crc_byte + len(crc)] = crc


class CheckState:
    """What a receiver remembers of one message."""

    def __init__(self, protection: FuzzProtection | None) -> None:
        self._protection = protection
        self._last: int | None = None
        self._outcomes: list[str] = []
        self._state = 0

    @property
    def is_invalid(self) -> bool:
        """Whether the message as a whole cannot be relied on."""
        return self._state == 2

    def take(self, payload: bytes) -> str:
        """Look at a frame: "usable", "corrupt", or intact but "out of order"."""
        if self._protection is None:
            return "usable"
        outcome = self._outcome(self._protection, payload)
        if outcome != "corrupt" or self._outcomes or self._state:
            self._judge(self._protection.windows, outcome)
        return outcome

    def _outcome(self, protection: FuzzProtection, payload: bytes) -> str:
        if len(payload) < protection.least or not protection.sound(payload):
            return "corrupt"
        counter, last = protection.counter(payload), self._last
        if counter >= protection.modulus:
            return "corrupt"
        self._last = counter
        if last is None:
            return "usable"
        return "usable" if 1 <= (counter - last) % protection.modulus <= protection.max_step else "out of order"

    def _judge(self, windows: tuple[Window, ...], outcome: str) -> None:
        """The state machine; INIT becomes INVALID only by too many errors, VALID as soon as its limits do not hold."""
        self._outcomes.append(outcome)
        limits = windows[self._state]
        seen = self._outcomes[-limits.window :]
        errors, intact = seen.count("corrupt"), seen.count("usable")
        if errors > limits.max_error:
            self._state = 2
        elif intact >= limits.min_ok:
            self._state = 1
        elif self._state == 1:
            self._state = 2


def draw_protection(rng: Random, identifier: int, size: int) -> FuzzProtection | None:
    """Draw a profile that fits a message and leaves room in it; None if there is none."""
    often = [name for name in _PROFILES if _PROFILES[name].least < size] + ["P01", "counter CRC8"]
    name = rng.choice([*often, *(name for name in often if name in {"P04", "P07"})])  # these fit few messages
    windows = _draw_windows(rng)
    if name == "counter CRC8":
        return _draw_counter_crc8(rng, identifier & 0xFFFF, size, windows)
    return _draw_autosar(rng, name, identifier, size, windows) if _PROFILES[name].least < size else None


def _draw_windows(rng: Random) -> tuple[Window, ...]:
    """Half of them let each frame count by itself."""
    if rng.random() < 0.5:
        return _ALWAYS_VALID
    sizes = [rng.randint(1, 12) for _ in range(3)]
    return tuple(Window(size, rng.randint(0, (size + 1) // 2), rng.randint(0, size // 2)) for size in sizes)


def _common_toml(profile: str, max_step: int, windows: tuple[Window, ...]) -> str:
    lines = [f'profile = "{profile}"\nmax_delta_counter = {max_step}']
    for state, (window, min_ok, max_error) in zip(("init", "valid", "invalid"), windows, strict=True):
        lines.append(f"{state} = {{ window = {window}, min_ok = {min_ok}, max_error = {max_error} }}")
    return "\n".join(lines) + "\n"


class _Profile(NamedTuple):
    """A profile of AUTOSAR; places are bytes from its offset."""

    mask: int
    counter: tuple[int, int, int]
    """Place, bytes, and bits that are it."""
    modulus: int
    crc: Callable[[bytes], int]
    crc_place: tuple[int, int]
    """Place and bytes."""
    length_place: tuple[int, int] = (0, 0)
    identity_place: tuple[int, int] = (0, 0)
    little_crc: bool = False

    @property
    def least(self) -> int:
        return (self.mask.bit_length() + 7) // 8


_PROFILES = {
    "P01": _Profile(0xFFF, (1, 1, 0xF), 15, crc8.gsm_a, (0, 1)),
    "P02": _Profile(0xFFF, (1, 1, 0xF), 16, crc8.autosar, (0, 1)),
    "P04": _Profile((1 << 96) - 1, (2, 2, 0xFFFF), 1 << 16, crc32.autosar, (8, 4), (0, 2), (4, 4)),
    "P05": _Profile(0xFFFFFF, (2, 1, 0xFF), 256, crc16.ibm_3740, (0, 2), little_crc=True),
    "P06": _Profile((1 << 40) - 1, (4, 1, 0xFF), 256, crc16.ibm_3740, (0, 2), (2, 2)),
    "P07": _Profile((1 << 160) - 1, (12, 4, 0xFFFFFFFF), 1 << 32, crc64.xz, (0, 8), (8, 4), (16, 4)),
    "P11": _Profile(0xFFF, (1, 1, 0xF), 15, crc8.gsm_a, (0, 1)),
}
_MODES = {"P01": ("both", "both", "alternating", "low", "nibble"), "P11": ("both", "nibble")}


def _draw_autosar(
    rng: Random, name: str, identifier: int, size: int, windows: tuple[Window, ...]
) -> FuzzProtection | None:
    profile, step = _PROFILES[name], rng.randint(1, 4)
    mode = rng.choice(_MODES.get(name, ("",)))
    offset = rng.choice((0, 0, 0, rng.randrange(size - profile.least))) if name != "P02" else 0
    longest = 0xFFFFFFFF if name in {"P04", "P07"} else 0xFFFF
    given = rng.randrange(longest + 1) if rng.random() < 0.5 else None
    identity = identifier & longest if given is None else given
    numbers = rng.randbytes(16)
    crc_byte, crc_bytes = offset + profile.crc_place[0], profile.crc_place[1]
    counter_byte = offset + profile.counter[0]

    def write_fields(data: bytearray) -> None:
        for value, (place, count) in ((len(data), profile.length_place), (identity, profile.identity_place)):
            if count:
                data[offset + place : offset + place + count] = value.to_bytes(count, "big")
        if mode == "nibble":
            data[counter_byte] = data[counter_byte] & 0xF | (identity >> 8 & 0xF) << 4

    def crc(data: bytes) -> bytes:
        low, high = identity & 0xFF, identity >> 8 & 0xFF
        counter = data[counter_byte] & 0xF
        before: dict[str, tuple[int, ...]] = {
            "": (),
            "both": (low, high),
            "alternating": (high if counter % 2 else low,),
            "low": (low,),
            "nibble": (low, 0),
        }
        after = {"P02": (numbers[counter],), "P05": (low, high), "P06": (high, low)}.get(name, ())
        covered = data[:crc_byte] + data[crc_byte + crc_bytes :]
        value = profile.crc(bytes(before[mode]) + covered + bytes(after))
        return value.to_bytes(crc_bytes, "little" if profile.little_crc else "big")

    toml = _common_toml(name, step, windows)
    if name == "P02":
        toml += f'data_id_list = {{ "%" = {list(numbers)} }}\n'
    else:
        toml += f"offset = {offset}\n"
        toml += f'data_id = {{ "%" = {given} }}\n' if given is not None else ""
        toml += f'data_id_mode = "{mode}"\n' if mode else ""
    return FuzzProtection(
        mask=(0xFFFF if mode == "nibble" else profile.mask) << 8 * offset,
        least=offset + profile.least,
        modulus=profile.modulus,
        counter_byte=counter_byte,
        counter_bytes=profile.counter[1],
        counter_ones=profile.counter[2],
        max_step=step,
        write_fields=write_fields,
        crc=crc,
        crc_byte=crc_byte,
        toml=toml,
        windows=windows,
    )


def _draw_counter_crc8(rng: Random, data_id: int, size: int, windows: tuple[Window, ...]) -> FuzzProtection | None:
    if size < 3:
        return None
    step = rng.randint(1, 4)
    byte, counter_byte = rng.sample(range(min(size, 4)), 2)
    shift, bytes_of_id, place = rng.choice((0, 3, 4)), rng.choice((0, 1, 2)), rng.choice(("before", "after"))
    modulus, algorithm = rng.choice((15, 16)), rng.choice(("sae_j1850", "autosar"))
    crc_8 = getattr(crc8, algorithm)
    identity = data_id.to_bytes(2, "little")[:bytes_of_id]

    def crc(data: bytes) -> bytes:
        rest = data[:byte] + data[byte + 1 :]
        return bytes([crc_8(identity + rest if place == "before" else rest + identity)])

    return FuzzProtection(
        mask=0xFF << 8 * byte | 0xF << (8 * counter_byte + shift),
        least=max(byte, counter_byte) + 1,
        modulus=modulus,
        counter_byte=counter_byte,
        counter_shift=shift,
        counter_ones=15,
        max_step=step,
        crc=crc,
        crc_byte=byte,
        toml=_common_toml("counter CRC8", step, windows)
        + f'counter = "Counter"\ncrc = "Crc"\nalgorithm = "{algorithm}"\ncounter_modulus = {modulus}\n'
        f'data_id_bytes = {bytes_of_id}\ndata_id_at = "{place}"\n',
        dbc_lines=(
            f' SG_ Crc : {8 * byte}|8@1+ (1,0) [0|0] "" X',
            f' SG_ Counter : {8 * counter_byte + shift}|4@1+ (1,0) [0|0] "" X',
        ),
        windows=windows,
    )
