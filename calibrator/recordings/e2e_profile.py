"""End-to-end protection over whole columns of payloads: profile 1A at once, others frame by frame.

In AUTOSAR E2E profile 1A byte 0 is CRC-8 SAE J1850 (polynomial 0x1D, start and final value 0x00 in this profile) over
the low and the high byte of the data identifier and the bytes after the CRC. AUTOSAR, "E2E Protocol Specification",
profile 1, both bytes of the data identifier included.
"""

import numpy as np
from cantools.database.can import Message
from numpy.typing import NDArray

from calibrator.drive import Mask
from ecu_node.database import VehicleDatabase
from ecu_node.e2e import Protection
from ecu_node.e2e_profiles import protection_of
from ecu_node.layout_e2e import ProfileP01

__all__ = ["is_sound", "message_is_sound", "p01_is_sound"]

_POLYNOMIAL = 0x1D
_NO_COUNTER = 15


def _table() -> NDArray[np.uint8]:
    crc = np.arange(256)
    for _ in range(8):
        crc = ((crc << 1) ^ np.where(crc & 0x80, _POLYNOMIAL, 0)) & 0xFF
    return crc.astype(np.uint8)


_TABLE = _table()


def p01_is_sound(data: NDArray[np.uint8], length: NDArray[np.uint8], data_id: int) -> Mask:
    """Check CRC and range of the counter of frames of one message.

    Parameters
    ----------
    data : ndarray of uint8, shape (n, W)
        Payloads, zeros after the length.
    length : ndarray of uint8, shape (n,)
        Payload bytes of each frame.
    data_id : int
        Data identifier of the message, 0 to 65535.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where byte 0 is the right CRC and the counter, the low half of byte 1, is not 15; False for frames shorter
        than these 2 bytes.
    """
    crc = np.full(len(data), _TABLE[_TABLE[data_id & 0xFF] ^ (data_id >> 8)], np.uint8)
    for column in range(1, data.shape[1]):
        crc = np.where(length > column, _TABLE[crc ^ data[:, column]], crc)
    return np.asarray((length >= 2) & (crc == data[:, 0]) & (data[:, 1] & 0x0F != _NO_COUNTER))


def is_sound(data: NDArray[np.uint8], length: NDArray[np.uint8], protection: Protection) -> Mask:
    """Check CRC and range of the counter of frames of one message, with any protection.

    Parameters
    ----------
    data, length :
        As for :func:`p01_is_sound`.
    protection : Protection
        Of the message.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where CRC and counter are possible; False for frames that are too short.
    """
    sound = np.zeros(len(data), np.bool_)
    for index, (row, size) in enumerate(zip(data, length.tolist(), strict=True)):
        if size >= protection.least_bytes:
            payload = bytearray(row[:size].tobytes())
            counter = payload[protection.counter_byte] >> protection.counter_shift & protection.counter_ones
            sound[index] = counter < protection.modulus and protection.is_sound(payload)
    return sound


def message_is_sound(
    database: VehicleDatabase, message: Message, data: NDArray[np.uint8], length: NDArray[np.uint8]
) -> Mask:
    """Check frames of one message as the layout says that it is protected.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout.
    message : Message
        That the frames are.
    data, length :
        As for :func:`p01_is_sound`.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where CRC and counter are possible, and everywhere if the message is not protected.
    """
    protection = protection_of(database, message)
    if protection is None:
        return np.ones(len(data), np.bool_)
    entry = database.layout.protection(message.name)
    if isinstance(entry, ProfileP01) and entry.data_id_mode == "both" and not entry.offset:
        return p01_is_sound(data, length, entry.data_id.get(message.name, message.frame_id & 0xFFFF))
    return is_sound(data, length, protection)
