"""End-to-end protection: frames that come in are checked before anything is read from them, outgoing ones get a CRC.

So a frame that came in corrupt can never go out with a valid CRC. AUTOSAR profiles P01, P02 and P05, computed by
autosar-e2e, and a counter with a CRC-8 (fastcrc), as control units often have.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

from cantools.database.can import Message
from e2e.p01 import (
    E2E_P01_DATAID_ALT,
    E2E_P01_DATAID_BOTH,
    E2E_P01_DATAID_LOW,
    E2E_P01_DATAID_NIBBLE,
    e2e_p01_check,
    e2e_p01_protect,
)
from e2e.p02 import e2e_p02_check, e2e_p02_protect
from e2e.p05 import e2e_p05_check, e2e_p05_protect

from ecu_node.core.signals import bit_place
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from ecu_node.layout import CounterCrc8, E2EWindow, EndToEnd, ProfileP01, ProfileP02, ProfileP05

__all__ = ["Check", "E2EState", "Protection", "Receiver", "protection_of"]


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


_OK = Check.OK  # looking up members of an enumeration is slow


_NEVER_INVALID = E2EWindow(window=1, min_ok=0, max_error=1)


@dataclass(frozen=True, kw_only=True)
class Protection:
    """How the frames of one message are protected.

    Attributes
    ----------
    header_mask : int
        Bits of CRC and counter in the frame read as one little-endian integer.
    least_bytes : int
        Bytes that a frame must have.
    modulus : int
        Number of codes of the counter, which runs from 0.
    max_step : int
        Largest step of the counter from one frame to the next that is used.
    is_sound : callable
        Whether the CRC of a payload is right; the counter is not looked at.
    counter_byte, counter_shift, counter_ones : int
        The counter of a payload is ``payload[counter_byte] >> counter_shift & counter_ones``.
    seal : callable
        Writes the CRC into a payload; its counter stays.
    advance : callable
        Lets the counter of a payload count on, and writes the CRC.
    """

    header_mask: int
    least_bytes: int
    modulus: int
    max_step: int
    is_sound: Callable[[bytearray], bool]
    counter_byte: int
    counter_shift: int = 0
    counter_ones: int
    seal: Callable[[bytearray], None]
    advance: Callable[[bytearray], None]
    windows: tuple[E2EWindow, E2EWindow, E2EWindow] = (_NEVER_INVALID, _NEVER_INVALID, _NEVER_INVALID)
    """By :class:`E2EState`: what makes a message in it VALID."""

    def before_first(self, payload: bytearray) -> None:
        """Prepare an empty payload so that its counter is 0 after it has first advanced."""
        payload[self.counter_byte] |= (self.modulus - 1) << self.counter_shift


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
        self._byte, self._shift, self._ones = (
            protection.counter_byte,
            protection.counter_shift,
            protection.counter_ones,
        )

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
        counter, modulus = payload[self._byte] >> self._shift & self._ones, self._modulus
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


_DATA_ID_MODES = {
    "both": E2E_P01_DATAID_BOTH,
    "alternating": E2E_P01_DATAID_ALT,
    "low": E2E_P01_DATAID_LOW,
    "nibble": E2E_P01_DATAID_NIBBLE,
}
"""``data_id_mode`` of a layout, as autosar-e2e has it."""
_NIBBLE = 0x0F
"""Bits of a counter of P01 or P02 in its byte."""
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
    protection = _by_profile(entry, message, where)
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


def _by_profile(entry: EndToEnd, message: Message, where: str) -> Protection:
    match entry:
        case ProfileP01():
            return _p01(entry, _data_id(entry.data_id, message))
        case ProfileP02():
            return _p02(entry, bytes(entry.data_id_list[message.name]))
        case ProfileP05():
            return _p05(entry, _data_id(entry.data_id, message))
        case _:
            return _counter_crc8(entry, message, where)


def _data_id(given: dict[str, int], message: Message) -> int:
    return given.get(message.name, message.frame_id & 0xFFFF)


def _p01(entry: ProfileP01, data_id: int) -> Protection:
    """CRC-8 SAE J1850 in a byte, a counter from 0 to 14 in the low nibble of the next one."""
    offset, mode = entry.offset, _DATA_ID_MODES[entry.data_id_mode]
    place, modulus = offset + 1, 15

    if (mode, offset) == (E2E_P01_DATAID_BOTH, 0):  # without keyword arguments, which cost time in every frame

        def is_sound(payload: bytearray) -> bool:
            return e2e_p01_check(payload, data_id)

        def advance(payload: bytearray) -> None:
            e2e_p01_protect(payload, data_id)

        def seal(payload: bytearray) -> None:
            payload[place] += -1 if payload[place] & _NIBBLE else modulus - 1  # it counts on to what it was
            e2e_p01_protect(payload, data_id)
    else:

        def is_sound(payload: bytearray) -> bool:
            return e2e_p01_check(payload, data_id, data_id_mode=mode, offset=offset)

        def advance(payload: bytearray) -> None:
            e2e_p01_protect(payload, data_id, data_id_mode=mode, offset=offset)

        def seal(payload: bytearray) -> None:
            e2e_p01_protect(payload, data_id, data_id_mode=mode, offset=offset, increment_counter=False)

    return Protection(
        header_mask=(0xFFFF if entry.data_id_mode == "nibble" else 0xFFF) << 8 * offset,
        least_bytes=offset + 2,
        modulus=modulus,
        max_step=entry.max_delta_counter,
        is_sound=is_sound,
        counter_byte=place,
        counter_ones=_NIBBLE,
        seal=seal,
        advance=advance,
    )


def _p02(entry: ProfileP02, data_id_list: bytes) -> Protection:
    """CRC-8 0x2F in byte 0, a counter from 0 to 15 in the low nibble of byte 1 that selects the data identifier."""
    return Protection(
        header_mask=0xFFF,
        least_bytes=2,
        modulus=16,
        max_step=entry.max_delta_counter,
        is_sound=lambda payload: e2e_p02_check(payload, data_id_list, length=0),
        counter_byte=1,
        counter_ones=_NIBBLE,
        seal=lambda payload: e2e_p02_protect(payload, data_id_list, increment_counter=False),
        advance=lambda payload: e2e_p02_protect(payload, data_id_list),
    )


def _p05(entry: ProfileP05, data_id: int) -> Protection:
    """CRC-16 CCITT in two bytes, low one first, and a counter from 0 to 255 in the next one."""
    offset = entry.offset
    return Protection(
        header_mask=0xFFFFFF << 8 * offset,
        least_bytes=offset + 3,
        modulus=256,
        max_step=entry.max_delta_counter,
        is_sound=lambda payload: e2e_p05_check(payload, data_id, offset=offset),
        counter_byte=offset + 2,
        counter_ones=0xFF,
        seal=lambda payload: e2e_p05_protect(payload, data_id, offset=offset, increment_counter=False),
        advance=lambda payload: e2e_p05_protect(payload, data_id, offset=offset),
    )


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
        counter_byte=counter_byte,
        counter_shift=shift,
        counter_ones=ones,
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
