"""Entries of a layout on how messages are protected end to end; what they do is in :mod:`ecu_node.e2e_profiles`."""

from typing import Annotated, Literal

import msgspec

from ecu_node.signal_names import Name

__all__ = ["PROFILES", "CounterCrc8", "EndToEnd", "ProfileP01", "ProfileP02", "ProfileP05"]

_DataId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]
_Offset = Annotated[int, msgspec.Meta(ge=0, le=60)]


class _Protected(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    messages: Annotated[list[Name], msgspec.Meta(min_length=1)]
    max_delta_counter: Annotated[int, msgspec.Meta(ge=1, le=255)] = 3
    """Largest step of the counter between two frames that is used: one more than the frames that may be lost."""


class ProfileP01(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P01"):
    """AUTOSAR E2E profile 1: CRC-8 and a counter of 4 bits."""

    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    data_id_mode: Literal["both", "alternating", "low", "nibble"] = "both"
    """Which bytes of the data identifier the CRC covers: profile 1A, 1B, the low one only, 1C."""
    offset: _Offset = 0
    """First byte of the header."""


class ProfileP02(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P02"):
    """AUTOSAR E2E profile 2: CRC-8 and a counter of 4 bits that selects one of 16 data identifiers."""

    data_id_list: dict[
        str, Annotated[list[Annotated[int, msgspec.Meta(ge=0, le=255)]], msgspec.Meta(min_length=16, max_length=16)]
    ]
    """Data identifiers per message."""


class ProfileP05(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P05"):
    """AUTOSAR E2E profile 5: CRC-16 and a counter of 8 bits."""

    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    offset: _Offset = 0
    """First byte of the header."""


class CounterCrc8(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="counter CRC8"):
    """A counter and a CRC-8 as signals of the DBC; the CRC covers all bytes but its own."""

    counter: Name
    crc: Name
    algorithm: str = "sae_j1850"
    """As fastcrc names it."""
    counter_modulus: Annotated[int, msgspec.Meta(ge=2, le=65536)] | None = None
    """Number of codes of the counter, which runs from 0; all that fit the signal where not given."""
    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    data_id_bytes: Literal[0, 1, 2] = 0
    """How many of its bytes the CRC covers too, the low one first."""
    data_id_at: Literal["before", "after"] = "before"
    """Whether they come before or after the payload."""


EndToEnd = ProfileP01 | ProfileP02 | ProfileP05 | CounterCrc8
"""How some messages are protected."""

PROFILES = ("P01", "P02", "P05", "counter CRC8")
"""Values of ``profile``."""
