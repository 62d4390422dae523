"""End-to-end protection: frames that come in are checked before anything is read from them, outgoing ones get a CRC.

So a frame that came in corrupt can never go out with a valid CRC. Supported are the AUTOSAR profiles P01, P02, P04,
P05, P06, P07 and P11, computed by autosar-e2e, and a counter with a CRC-8 (fastcrc), as many control units have it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

from cantools.database.can import Message
from e2e import p01, p02, p04, p05, p06, p07, p11

from ecu_node.core.signals import BitPlace, bit_place
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from ecu_node.layout import AutosarProfile, CounterCrc8, E2EWindow, ProfileP02


class Check(IntEnum):
    """Outcome of checking one frame; if it is OK or LOST, its content is new and intact."""

    OK = 0
    """Intact, and the next one in order."""
    LOST = 1
    """Intact, but a few frames before it were lost."""
    REPEATED = 2
    """Intact, but with the same counter as the frame before."""
    JUMPED = 3
    """Intact, but its counter has advanced further than the layout allows."""
    CORRUPT = 4
    """Too short, with a wrong CRC, or with an impossible counter."""


class E2EState(IntEnum):
    """State of a message in AUTOSAR's E2E state machine."""

    INIT = 0
    VALID = 1
    INVALID = 2


_OK = Check.OK  # looking up members of an enumeration is slow


@dataclass(frozen=True, kw_only=True)
class Protection:
    """How the frames of one message are protected.

    Attributes
    ----------
    header_mask : int
        Bits of CRC, counter, length and data identifier, as far as the profile writes them, in the frame read as one
        little-endian integer.
    least_bytes : int
        Bytes that a frame must have.
    modulus : int
        Number of codes of the counter, which runs from 0.
    max_step : int
        Largest step of the counter from one frame to the next with which the next one is still used.
    counter : BitPlace
        Where the counter stands: within one byte, or in whole bytes, the most significant one first.
    check, protect : callable
        Functions of payload and identity, like those of autosar-e2e. The first returns whether the CRC is right; the
        second increments the counter (unless ``increment_counter=False``) and writes CRC, length and data identifier,
        as far as the profile has them.
    identity : int or bytes
        Data identifier, or the list of them.
    windows : tuple of E2EWindow
        For each :class:`E2EState`, what it takes for a message in that state to become or stay VALID.
    """

    header_mask: int
    least_bytes: int
    modulus: int
    max_step: int
    counter: BitPlace
    check: Callable[..., bool]
    protect: Callable[..., None]
    identity: int | bytes
    windows: tuple[E2EWindow, E2EWindow, E2EWindow]

    def is_sound(self, payload: bytearray) -> bool:
        """Check whether the CRC of a payload is right; the counter is not looked at."""
        return self.check(payload, self.identity)

    def is_intact(self, payload: bytearray) -> bool:
        """Check whether a payload, by itself, is long enough, its CRC right and its counter below ``modulus``."""
        return len(payload) >= self.least_bytes and self.is_sound(payload) and self.counter_of(payload) < self.modulus

    def counter_of(self, payload: bytes | bytearray) -> int:
        """Read the counter of a payload of at least ``least_bytes``."""
        place = self.counter
        return int.from_bytes(payload[place.first : place.end]) >> place.shift & place.highest

    def before_first(self, payload: bytearray) -> None:
        """Prepare an empty payload so that the first :meth:`advance` sets its counter to 0."""
        self.counter.put(payload, self.modulus - 1)

    def seal(self, payload: bytearray) -> None:
        """Write CRC, length and data identifier, as far as the profile has them; the counter stays as it is."""
        place, last = self.counter, self.counter.end - 1
        if payload[last] & place.highest and not place.shift:
            payload[last] -= 1  # protect adds it again; the keyword argument would cost three times as much
            self.protect(payload, self.identity)
        else:
            self.protect(payload, self.identity, increment_counter=False)

    def advance(self, payload: bytearray) -> None:
        """Increment the counter; write CRC, length and data identifier, as far as the profile has them."""
        self.protect(payload, self.identity)


class Receiver:
    """Checks the frames of one message in the order of their arrival.

    Parameters
    ----------
    protection : Protection
        Protection of the message.

    Attributes
    ----------
    state : E2EState
        Whether the message as a whole can be relied on, by AUTOSAR's E2E state machine. A repeated frame, or one
        whose counter jumped, counts neither for ``min_ok`` nor for ``max_error`` of a window.
    """

    def __init__(self, protection: Protection) -> None:
        self.state = E2EState.INIT
        self._protection = protection
        self._expected: int | None = None  # the first intact frame may have any counter
        self._past: list[Check] = []
        self._remembered = max(window.window for window in protection.windows)
        place = protection.counter
        self._is_short = place.end - place.first == 1
        self._is_steady = False  # all that is remembered was in order, and the counter is within a byte
        self._check, self._identity, self._least_bytes = protection.check, protection.identity, protection.least_bytes
        self._byte, self._shift, self._ones = place.first, place.shift, place.highest
        self._modulus = protection.modulus

    def check(self, payload: bytearray) -> Check:
        """Check one frame and remember its counter.

        Parameters
        ----------
        payload : bytearray
            Data of the frame.

        Returns
        -------
        Check
            A corrupt frame leaves the remembered counter as it was; after a jump the next frame in order is OK. The
            first intact frame is OK with any counter.
        """
        if self._is_steady and len(payload) >= self._least_bytes:
            counter = payload[self._byte] >> self._shift & self._ones
            if counter == self._expected and self._check(payload, self._identity):
                self._expected = (counter + 1) % self._modulus
                return _OK
        check = self._checked(payload)
        self._judge(check)
        return check

    def restart(self) -> None:
        """Begin anew after a silence: any counter may come next, and a VALID message becomes INVALID."""
        self._expected = None
        self._past.clear()
        if self.state is E2EState.VALID:
            self.state = E2EState.INVALID

    def _checked(self, payload: bytearray) -> Check:
        """Check a frame, and expect the counter after its own."""
        if not self._protection.is_intact(payload):
            return Check.CORRUPT
        counter, before = self._protection.counter_of(payload), self._expected
        self._expected = (counter + 1) % self._modulus
        step = 1 if before is None else (counter - before + 1) % self._modulus
        if step <= 1:
            return _OK if step else Check.REPEATED
        return Check.LOST if step <= self._protection.max_step else Check.JUMPED

    def _judge(self, check: Check) -> None:
        """Update the state of the message after the check of one more frame."""
        if check is Check.CORRUPT and not self._past and self.state is E2EState.INIT:
            return  # nothing was received yet
        self._past = [*self._past, check][-self._remembered :]
        allowed = self._protection.windows[self.state]
        last = self._past[-allowed.window :]
        errors = last.count(Check.CORRUPT)
        if errors <= allowed.max_error and sum(item <= Check.LOST for item in last) >= allowed.min_ok:
            self.state = E2EState.VALID
        elif self.state is E2EState.VALID or errors > allowed.max_error:
            self.state = E2EState.INVALID
        self._is_steady = self._is_short and self._past == [_OK] * self._remembered


class _Profile(NamedTuple):
    """A profile of AUTOSAR: its functions in autosar-e2e, the size of its header, and its counter."""

    check: Callable[..., bool]
    protect: Callable[..., None]
    header_bits: int
    counter_byte: int
    """Most significant byte of the counter, as counted from the start of the header."""
    counter_bits: int
    modulus: int


_PROFILES = {
    "P01": _Profile(p01.e2e_p01_check, p01.e2e_p01_protect, 12, 1, 4, 15),
    "P02": _Profile(p02.e2e_p02_check, p02.e2e_p02_protect, 12, 1, 4, 16),
    "P04": _Profile(p04.e2e_p04_check, p04.e2e_p04_protect, 96, 2, 16, 1 << 16),
    "P05": _Profile(p05.e2e_p05_check, p05.e2e_p05_protect, 24, 2, 8, 1 << 8),
    "P06": _Profile(p06.e2e_p06_check, p06.e2e_p06_protect, 40, 4, 8, 1 << 8),
    "P07": _Profile(p07.e2e_p07_check, p07.e2e_p07_protect, 160, 12, 32, 1 << 32),
    "P11": _Profile(p11.e2e_p11_check, p11.e2e_p11_protect, 12, 1, 4, 15),
}
_DATA_ID_MODES = {
    "both": p01.E2E_P01_DATAID_BOTH,
    "alternating": p01.E2E_P01_DATAID_ALT,
    "low": p01.E2E_P01_DATAID_LOW,
    "nibble": p01.E2E_P01_DATAID_NIBBLE,
}
"""Constants of autosar-e2e for ``data_id_mode`` of a layout; the two that P11 has are the same numbers."""
_LONGEST_CLASSIC, _FD_LENGTHS = 8, (12, 16, 20, 24, 32, 48, 64)
"""Longest payload of classic CAN, and the longer ones that CAN FD has. [byte]"""


def protection_of(database: VehicleDatabase, message: Message) -> Protection | None:
    """Return how a message is protected.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    message : Message
        A message of the DBC.

    Returns
    -------
    Protection or None
        Its protection; None if the layout names none for it.

    Raises
    ------
    LayoutError
        If the message cannot carry its protection, or has no signal for its counter or CRC, or several.
    DatabaseError
        If the signal of its counter or CRC is a floating-point number or wider than 64 bits.
    """
    layout = database.layout
    found = next((pair for pair in layout.protections if message.name in pair[1].messages), None)
    if found is None:
        return None
    place, entry = found
    where = f"{layout.path}: {place}: message {message.name}"
    if message.length > _LONGEST_CLASSIC and message.length not in _FD_LENGTHS:
        raise LayoutError(
            f"{where} has {message.length} bytes in the DBC; CAN FD pads it, so that its CRC cannot be checked; "
            f"expected {', '.join(map(str, _FD_LENGTHS))}"
        )
    how = _counter_crc8(entry, message, where) if isinstance(entry, CounterCrc8) else _autosar(entry, message, where)
    windows = (entry.init, entry.valid, entry.invalid)
    protection = Protection(max_step=entry.max_delta_counter, windows=windows, **how)
    if entry.max_delta_counter >= protection.modulus:
        raise LayoutError(
            f"{where}: max_delta_counter is {entry.max_delta_counter}, but the counter has {protection.modulus} codes "
            f"only; with it no jump could be noticed"
        )
    if message.length < protection.least_bytes:
        raise LayoutError(
            f"{where} has {message.length} bytes, too few for the header of {protection.least_bytes} bytes"
        )
    return protection


def _data_id(given: dict[str, int], message: Message, highest: int) -> int:
    """Return the data identifier that is given for a message, else the message's own identifier, cut to `highest`."""
    return given.get(message.name, message.frame_id & highest)


def _autosar(entry: AutosarProfile, message: Message, where: str) -> dict[str, Any]:
    """Return the fields of a :class:`Protection` by a profile of AUTOSAR."""
    profile = _PROFILES[entry.profile]
    header_bits, options = profile.header_bits, dict[str, int]()
    identity: int | bytes
    if isinstance(entry, ProfileP02):
        identity, offset = bytes(entry.data_id_list[message.name]), 0
    else:
        mode = _DATA_ID_MODES[getattr(entry, "data_id_mode", "both")]
        is_nibble = mode == p01.E2E_P01_DATAID_NIBBLE
        highest = 0xFFFFFFFF if entry.profile in {"P04", "P07"} else 0xFFF if is_nibble else 0xFFFF
        identity, offset = _data_id(entry.data_id, message, highest), entry.offset
        if is_nibble and identity > highest:
            raise LayoutError(
                f'{where}: data_id {identity} is above {highest}, the highest with data_id_mode = "nibble"'
            )
        header_bits += 4 * is_nibble  # sent above the counter
        options = {key: value for key, value in (("offset", offset), ("data_id_mode", mode)) if value}
    first, bits = offset + profile.counter_byte, profile.counter_bits
    return {
        "header_mask": (1 << header_bits) - 1 << 8 * offset,
        "least_bytes": offset + (header_bits + 7) // 8,
        "modulus": profile.modulus,
        "counter": BitPlace(first=first, end=first + (bits + 7) // 8, order="big", shift=0, length=bits, signed=False),
        # keyword arguments would double the time of every frame
        "check": partial(profile.check, **options) if options else profile.check,
        "protect": partial(profile.protect, **options) if options else profile.protect,
        "identity": identity,
    }


def _counter_crc8(entry: CounterCrc8, message: Message, where: str) -> dict[str, Any]:
    """Return the fields of a :class:`Protection` by a counter and a CRC-8, both of them signals of the DBC.

    The CRC covers all other bytes, and a data identifier if there is one. Errors are those of :func:`protection_of`.
    """
    signals = {signal.name: signal for signal in message.signals}
    for name in (entry.counter, entry.crc):
        if name not in signals:
            raise LayoutError(f"{where} has no signal {name!r}; it has {', '.join(signals)}")
        if sum(signal.name == name for signal in message.signals) > 1:
            raise LayoutError(f"{where} has several signals named {name!r}; rename all but one in the DBC")
    counter_place, crc_place = bit_place(signals[entry.counter]), bit_place(signals[entry.crc])
    modulus, largest_id = entry.counter_modulus or counter_place.highest + 1, (1 << 8 * entry.data_id_bytes) - 1
    data_id = _data_id(entry.data_id, message, largest_id)
    for is_wrong, text in (
        (crc_place.length != 8 or crc_place.shift, f"signal {entry.crc} must be one whole byte to be a CRC-8"),
        (
            counter_place.end - counter_place.first > 1,
            f"signal {entry.counter} must be within one byte to be a counter",
        ),
        (
            counter_place.mask & crc_place.mask,
            f"signals {entry.counter} and {entry.crc} overlap; each needs bits of its own",
        ),
        (
            counter_place.signed or modulus > counter_place.highest + 1,
            f"signal {entry.counter} cannot count from 0 to {modulus - 1}",
        ),
        (
            data_id > largest_id,
            f"data_id {data_id} does not fit into data_id_bytes = {entry.data_id_bytes}",
        ),
    ):
        if is_wrong:
            raise LayoutError(f"{where}: {text}")
    from fastcrc import crc8 as known  # noqa: PLC0415  # most vehicles do not need it, and the node is to stay small

    if entry.algorithm not in known.algorithms_available:
        raise LayoutError(
            f"{where}: algorithm {entry.algorithm!r} is not known; known are "
            f"{', '.join(sorted(known.algorithms_available))}"
        )
    crc8: Callable[[bytes], int] = getattr(known, entry.algorithm)
    byte = crc_place.first
    counter_byte, shift, ones = counter_place.first, counter_place.shift, counter_place.highest
    is_before = entry.data_id_at == "before"

    def crc(payload: bytearray, identity: bytes) -> int:
        covered = payload[:byte] + payload[byte + 1 :]
        return crc8(identity + covered if is_before else bytes(covered + identity))

    def protect(payload: bytearray, identity: bytes, *, increment_counter: bool = True) -> None:
        if increment_counter:
            counter = ((payload[counter_byte] >> shift & ones) + 1) % modulus
            payload[counter_byte] = payload[counter_byte] & ~(ones << shift) | counter << shift
        payload[byte] = crc(payload, identity)

    return {
        "header_mask": counter_place.mask | crc_place.mask,
        "least_bytes": max(counter_place.end, crc_place.end),
        "modulus": modulus,
        "counter": counter_place,
        "check": lambda payload, identity: payload[byte] == crc(payload, identity),
        "protect": protect,
        "identity": data_id.to_bytes(entry.data_id_bytes, "little"),
    }
