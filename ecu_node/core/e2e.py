"""End-to-end protection: frames that come in are checked before anything is read from them, outgoing ones get a CRC.

So a frame that came in corrupt can never go out with a valid CRC. AUTOSAR profiles P01, P02, P04, P05, P06, P07 and
P11, computed by autosar-e2e, and a counter with a CRC-8 (fastcrc), as control units often have.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple, TypeVar

from cantools.database.can import Message
from e2e import p01, p02, p04, p05, p06, p07, p11

from ecu_node.core.signals import BitPlace, bit_place
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from ecu_node.layout import (
    AutosarProfile,
    CounterCrc8,
    E2EWindow,
    ProfileP01,
    ProfileP02,
    ProfileP04,
    ProfileP05,
    ProfileP06,
    ProfileP07,
    ProfileP11,
)


class Check(IntEnum):
    """Outcome of checking one frame; up to LOST its content is new and intact."""

    OK = 0
    """Valid, and the next one in order."""
    LOST = 1
    """Valid, but a few frames before it were lost."""
    REPEATED = 2
    """Valid, but seen before."""
    JUMPED = 3
    """Valid, but its counter is further on than the layout allows."""
    CORRUPT = 4
    """CRC or counter impossible."""


class E2EState(IntEnum):
    """Of a message, as AUTOSAR's E2E state machine has it."""

    INIT = 0
    VALID = 1
    INVALID = 2


_T = TypeVar("_T")
_OK = Check.OK  # looking up members of an enumeration is slow


_NEVER_INVALID = E2EWindow(window=1, min_ok=0, max_error=1)


@dataclass(frozen=True, kw_only=True)
class Protection:
    """How the frames of one message are protected.

    Attributes
    ----------
    header_mask : int
        Bits of CRC, counter and all else that the profile writes, in the frame read as one little-endian integer.
    least_bytes : int
        Bytes that a frame must have.
    modulus : int
        Number of codes of the counter, which runs from 0.
    max_step : int
        Largest step of the counter from one frame to the next that is used.
    is_sound : callable
        Whether the CRC of a payload is right; the counter is not looked at.
    counter : BitPlace
        Where the counter stands: within one byte, or in whole bytes, the most significant one first.
    seal : callable
        Writes CRC, length and data identifier, as the profile has them, into a payload; its counter stays.
    advance : callable
        The same after the counter of the payload has counted on.
    """

    header_mask: int
    least_bytes: int
    modulus: int
    max_step: int
    is_sound: Callable[[bytearray], bool]
    counter: BitPlace
    seal: Callable[[bytearray], None]
    advance: Callable[[bytearray], None]
    windows: tuple[E2EWindow, E2EWindow, E2EWindow] = (_NEVER_INVALID, _NEVER_INVALID, _NEVER_INVALID)
    """By :class:`E2EState`: what makes a message in it VALID."""

    def counter_of(self, payload: bytes | bytearray) -> int:
        """Read the counter of a payload of at least ``least_bytes``."""
        place = self.counter
        return int.from_bytes(payload[place.first : place.end]) >> place.shift & place.highest

    def before_first(self, payload: bytearray) -> None:
        """Prepare an empty payload so that its counter is 0 after it has first advanced."""
        self.counter.put(payload, self.modulus - 1)


class Receiver:
    """Checks the frames of one message in the order of their arrival.

    Parameters
    ----------
    protection : Protection
        Of the message.

    Attributes
    ----------
    state : E2EState
        Whether the message as a whole can be relied on, by AUTOSAR's E2E state machine. A repeated frame, or one
        further on than is allowed, counts neither as intact nor as corrupt.
    """

    def __init__(self, protection: Protection) -> None:
        self.state = E2EState.INIT
        self._protection = protection
        self._expected = -1  # the first intact frame may have any counter
        self._past: deque[Check] = deque(maxlen=max(window.window for window in protection.windows))
        self._is_steady = False  # VALID, and all that is remembered was in order
        self._is_sound, self._least_bytes, self._modulus = (
            protection.is_sound,
            protection.least_bytes,
            protection.modulus,
        )
        place = protection.counter
        self._byte, self._shift, self._ones = place.first, place.shift, place.highest
        self._whole_bytes = slice(place.first, place.end) if place.end - place.first > 1 else None

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
            if self._whole_bytes is None:
                counter = payload[self._byte] >> self._shift & self._ones
            else:
                counter = int.from_bytes(payload[self._whole_bytes])
            if counter == self._expected and self._is_sound(payload):
                self._expected = counter + 1 if counter + 1 < self._modulus else 0
                return _OK
        check = self._checked(payload)
        self._judge(check)
        return check

    def restart(self) -> None:
        """Begin anew after a silence: the next counter may be any, but a single frame makes nothing VALID."""
        self._expected, self._is_steady = -1, False
        self._past.clear()
        if self.state is E2EState.VALID:
            self.state = E2EState.INVALID

    def _checked(self, payload: bytearray) -> Check:
        if len(payload) < self._least_bytes or not self._is_sound(payload):
            return Check.CORRUPT
        counter, modulus = self._protection.counter_of(payload), self._modulus
        if counter >= modulus:
            return Check.CORRUPT
        before, self._expected = self._expected, (counter + 1) % modulus
        step = 1 if before < 0 else (counter - before + 1) % modulus
        if step == 0:
            return Check.REPEATED
        if step == 1:
            return _OK
        return Check.LOST if step <= self._protection.max_step else Check.JUMPED

    def _judge(self, check: Check) -> None:
        if check is Check.CORRUPT and not self._past and self.state is E2EState.INIT:
            return  # nothing was received yet
        self._past.append(check)
        allowed = self._protection.windows[self.state]
        last = [*self._past][-allowed.window :]
        errors = last.count(Check.CORRUPT)
        if errors <= allowed.max_error and sum(item <= Check.LOST for item in last) >= allowed.min_ok:
            self.state = E2EState.VALID
        elif self.state is E2EState.VALID or errors > allowed.max_error:
            self.state = E2EState.INVALID
        whole = len(self._past) == self._past.maxlen
        self._is_steady = whole and self.state is E2EState.VALID and max(self._past) <= Check.LOST


class _Profile(NamedTuple):
    """A profile of AUTOSAR, by autosar-e2e, and its header, counted from the offset."""

    check: Callable[..., bool]
    protect: Callable[..., None]
    header_bits: int
    counter_byte: int
    """The most significant one."""
    counter_bits: int
    modulus: int


_PROFILES = {
    ProfileP01: _Profile(p01.e2e_p01_check, p01.e2e_p01_protect, 12, 1, 4, 15),
    ProfileP02: _Profile(p02.e2e_p02_check, p02.e2e_p02_protect, 12, 1, 4, 16),
    ProfileP04: _Profile(p04.e2e_p04_check, p04.e2e_p04_protect, 96, 2, 16, 1 << 16),
    ProfileP05: _Profile(p05.e2e_p05_check, p05.e2e_p05_protect, 24, 2, 8, 1 << 8),
    ProfileP06: _Profile(p06.e2e_p06_check, p06.e2e_p06_protect, 40, 4, 8, 1 << 8),
    ProfileP07: _Profile(p07.e2e_p07_check, p07.e2e_p07_protect, 160, 12, 32, 1 << 32),
    ProfileP11: _Profile(p11.e2e_p11_check, p11.e2e_p11_protect, 12, 1, 4, 15),
}
_DATA_ID_MODES = {
    "both": p01.E2E_P01_DATAID_BOTH,
    "alternating": p01.E2E_P01_DATAID_ALT,
    "low": p01.E2E_P01_DATAID_LOW,
    "nibble": p01.E2E_P01_DATAID_NIBBLE,
}
"""``data_id_mode`` of a layout, as autosar-e2e has it; P11 has two of them, with the same numbers."""
_LONGEST_CLASSIC, _FD_LENGTHS = 8, (12, 16, 20, 24, 32, 48, 64)
"""Bytes of payloads."""


def protection_of(database: VehicleDatabase, message: Message) -> Protection | None:
    """How a message is protected.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    message : Message
        A message of the DBC.

    Returns
    -------
    Protection or None
        None if the layout does not protect it.

    Raises
    ------
    LayoutError
        If the message cannot carry its protection.
    """
    layout = database.layout
    entry = layout.protection(message.name)
    if entry is None:
        return None
    where = f"{layout.path}: {layout.protection_place(message.name)}: message {message.name}"
    if message.length > _LONGEST_CLASSIC and message.length not in _FD_LENGTHS:
        raise LayoutError(
            f"{where} has {message.length} bytes in the DBC; CAN FD pads it, so that its CRC cannot be checked; "
            f"expected {', '.join(map(str, _FD_LENGTHS))}"
        )
    protection = _counter_crc8(entry, message, where) if isinstance(entry, CounterCrc8) else _autosar(entry, message)
    if entry.max_delta_counter >= protection.modulus:
        raise LayoutError(
            f"{where}: max_delta_counter is {entry.max_delta_counter}, but the counter has {protection.modulus} codes "
            f"only; with it no jump could be noticed"
        )
    if message.length < protection.least_bytes:
        raise LayoutError(
            f"{where} has {message.length} bytes, too few for the header of {protection.least_bytes} bytes"
        )
    return replace(protection, windows=(entry.init, entry.valid, entry.invalid))


def _data_id(given: dict[str, int], message: Message, highest: int = 0xFFFF) -> int:
    return given.get(message.name, message.frame_id & highest)


def _autosar(entry: AutosarProfile, message: Message) -> Protection:
    """Protection by a profile of AUTOSAR."""
    check, protect, header_bits, counter_byte, counter_bits, modulus = _PROFILES[type(entry)]
    identity: int | bytes
    if isinstance(entry, ProfileP02):
        identity, offset = bytes(entry.data_id_list[message.name]), 0
    else:
        highest = 0xFFFFFFFF if isinstance(entry, ProfileP04 | ProfileP07) else 0xFFFF
        identity, offset = _data_id(entry.data_id, message, highest), entry.offset
    options = {"offset": offset}
    if isinstance(entry, ProfileP01 | ProfileP11):
        options["data_id_mode"] = _DATA_ID_MODES[entry.data_id_mode]
        if entry.data_id_mode == "nibble":  # it is sent above the counter
            header_bits += 4
    options = {key: value for key, value in options.items() if value}
    first = offset + counter_byte
    last, ones = first + (counter_bits - 1) // 8, (1 << min(counter_bits, 8)) - 1

    def seal(payload: bytearray) -> None:
        if payload[last] & ones and not options:
            payload[last] -= 1  # then it counts on to what it was: no keyword argument, half the time
            protect(payload, identity)
        else:
            protect(payload, identity, increment_counter=False, **options)

    return Protection(
        header_mask=(1 << header_bits) - 1 << 8 * offset,
        least_bytes=offset + (header_bits + 7) // 8,
        modulus=modulus,
        max_step=entry.max_delta_counter,
        is_sound=_bound(check, identity, options),
        counter=BitPlace(first=first, end=last + 1, order="big", shift=0, length=counter_bits, signed=False),
        seal=seal,
        advance=_bound(protect, identity, options),
    )


def _bound(function: Callable[..., _T], identity: int | bytes, options: dict[str, int]) -> Callable[[bytearray], _T]:
    """A function of autosar-e2e for one message; keyword arguments would double the time of every frame."""
    if not options:
        return lambda payload: function(payload, identity)
    return lambda payload: function(payload, identity, **options)


def _counter_crc8(entry: CounterCrc8, message: Message, where: str) -> Protection:
    """A counter and a CRC-8, both signals of the DBC; the CRC covers all other bytes, and a data identifier if any."""
    signals = {signal.name: signal for signal in message.signals}
    for name in (entry.counter, entry.crc):
        if name not in signals:
            raise LayoutError(f"{where} has no signal {name!r}; it has {', '.join(signals)}")
    counter_place, crc_place = bit_place(signals[entry.counter]), bit_place(signals[entry.crc])
    if crc_place.length != 8 or crc_place.shift:
        raise LayoutError(f"{where}: signal {entry.crc} must be one whole byte to be a CRC-8")
    modulus = entry.counter_modulus or counter_place.highest + 1
    if counter_place.end - counter_place.first > 1:
        raise LayoutError(f"{where}: signal {entry.counter} must be within one byte to be a counter")
    if counter_place.mask & crc_place.mask:
        raise LayoutError(f"{where}: signals {entry.counter} and {entry.crc} overlap; each needs bits of its own")
    if counter_place.signed or modulus > counter_place.highest + 1:
        raise LayoutError(f"{where}: signal {entry.counter} cannot count from 0 to {modulus - 1}")
    crc8 = _algorithm(entry.algorithm, where)
    if message.name in entry.data_id and entry.data_id[message.name] >= 1 << 8 * entry.data_id_bytes:
        raise LayoutError(
            f"{where}: data_id {entry.data_id[message.name]} does not fit into data_id_bytes = {entry.data_id_bytes}"
        )
    identity = _data_id(entry.data_id, message).to_bytes(2, "little")[: entry.data_id_bytes]
    before, after = (identity, b"") if entry.data_id_at == "before" else (b"", identity)
    byte = crc_place.first
    counter_byte, shift, ones = counter_place.first, counter_place.shift, counter_place.highest

    def crc(payload: bytearray) -> int:
        return crc8(b"".join((before, payload[:byte], payload[byte + 1 :], after)))

    def seal(payload: bytearray) -> None:
        payload[byte] = crc(payload)

    def advance(payload: bytearray) -> None:
        counter = ((payload[counter_byte] >> shift & ones) + 1) % modulus
        payload[counter_byte] = payload[counter_byte] & ~(ones << shift) | counter << shift
        seal(payload)

    return Protection(
        header_mask=counter_place.mask | crc_place.mask,
        least_bytes=max(counter_place.end, crc_place.end),
        modulus=modulus,
        max_step=entry.max_delta_counter,
        is_sound=lambda payload: payload[byte] == crc(payload),
        counter=counter_place,
        seal=seal,
        advance=advance,
    )


def _algorithm(name: str, where: str) -> Callable[[bytes], int]:
    from fastcrc import crc8  # noqa: PLC0415  # most vehicles do not need it, and the node is to stay small

    if name not in crc8.algorithms_available:
        raise LayoutError(
            f"{where}: algorithm {name!r} is not known; known are {', '.join(sorted(crc8.algorithms_available))}"
        )
    return getattr(crc8, name)  # type: ignore[no-any-return]
