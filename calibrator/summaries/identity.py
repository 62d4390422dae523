"""Identity of a store: its summaries add up only if branches, inputs, filters and time base are the same."""

import hashlib
from typing import Annotated

import msgspec

from calibrator.drive import Equipment
from calibrator.errors import DriveError, FleetError
from calibrator.files.storage import Storage
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.moments import BLOCK_S
from ecu_node.database import VehicleDatabase

__all__ = [
    "FEWEST_BUCKETS",
    "SCHEMA_VERSION",
    "StoreIdentity",
    "bucket_of",
    "read_identity",
    "store_identity",
    "write_identity",
]

SCHEMA_VERSION = 4
FILE = "summaries.json"
FEWEST_BUCKETS, MOST_BUCKETS = 16, 32_768
"""Range of the number of buckets: with more, a killed run loses fewer vehicles; with too many, listing takes long."""
_HASH_BYTES = 8
VEHICLES_PER_BUCKET = 256
"""Intended size of a bucket: a few megabytes, which are read in a fraction of a second."""


class StoreIdentity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What all summaries of a store have in common.

    Attributes
    ----------
    schema_version : int
        Version of the store's format.
    layout, layout_sha256, dbc_sha256 : str
        Name of the layout, and digests of layout and DBC.
    branches, inputs, fleet_inputs : tuple of str
        Branches and model inputs of the fleet, see :class:`~calibrator.drive.Equipment`.
    notices : tuple of str
        Branches and inputs of the layout that the store does not use, and why, in words.
    bank : FilterBank
        Filters of the inputs ``fleet_inputs``.
    block_s : float
        Length of a block. [s]
    buckets : int
        Number of files that the vehicles are spread over.
    fleet : str
        Name of the fleet.
    """

    schema_version: int = SCHEMA_VERSION
    layout: str
    layout_sha256: str
    dbc_sha256: str
    branches: Annotated[tuple[str, ...], msgspec.Meta(min_length=2)]
    inputs: tuple[str, ...]
    fleet_inputs: tuple[str, ...]
    notices: tuple[str, ...]
    bank: FilterBank
    block_s: float
    buckets: Annotated[int, msgspec.Meta(ge=FEWEST_BUCKETS, le=MOST_BUCKETS)]
    fleet: str

    @property
    def equipment(self) -> Equipment:
        """Branches and inputs of the fleet."""
        return Equipment(
            branches=self.branches, inputs=self.inputs, fleet_inputs=self.fleet_inputs, notices=self.notices
        )

    def difference(self, other: "StoreIdentity") -> str:
        """Say in words why summaries of another store cannot be added to this one; return an empty text if they can."""
        for name in ("layout_sha256", "dbc_sha256", "branches", "fleet_inputs", "bank", "block_s"):
            mine, its = getattr(self, name), getattr(other, name)
            if mine != its:
                return f"{name} {_short(mine)} against {_short(its)}"
        return ""


def _short(value: object) -> str:
    text = ", ".join(value) if isinstance(value, tuple) else str(value)
    text = value.identity if isinstance(value, FilterBank) else text
    return text[:60]


def bucket_of(vehicle: str, buckets: int) -> int:
    """Return the bucket of a vehicle, 0 to ``buckets - 1``; it depends on nothing but the vehicle's name."""
    digest = hashlib.blake2b(vehicle.encode(), digest_size=_HASH_BYTES).digest()
    return int.from_bytes(digest, "big") % buckets


def store_identity(
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    vehicles: int,
    fleet: str,
    bank: FilterBank | None = None,
) -> StoreIdentity:
    """Return the identity of a new store.

    Parameters
    ----------
    equipment : Equipment
        Branches and inputs of the fleet.
    database : VehicleDatabase
        DBC and layout.
    vehicles : int
        Number of vehicles expected; it decides the number of buckets.
    fleet : str
        Name of the fleet.
    bank : FilterBank or None
        Filters of the fleet inputs; None: the plain inputs.

    Returns
    -------
    StoreIdentity
        Identity with the present schema version.
    """
    wanted = 1 << max(vehicles // VEHICLES_PER_BUCKET, 1).bit_length()
    return StoreIdentity(
        layout=database.layout.name,
        layout_sha256=database.layout.digest,
        dbc_sha256=database.digest,
        branches=equipment.branches,
        inputs=equipment.inputs,
        fleet_inputs=equipment.fleet_inputs,
        notices=equipment.notices,
        bank=bank or FilterBank(input_names=equipment.fleet_inputs, period_s=database.layout.period_s),
        block_s=BLOCK_S,
        buckets=min(max(wanted, FEWEST_BUCKETS), MOST_BUCKETS),
        fleet=fleet,
    )


def write_identity(storage: Storage, identity: StoreIdentity) -> None:
    """Write the identity of a new store."""
    storage.write(FILE, msgspec.json.format(msgspec.json.encode(identity), indent=2) + b"\n")


def read_identity(storage: Storage, database: VehicleDatabase | None = None) -> StoreIdentity | None:
    """Read the identity of a store.

    Parameters
    ----------
    storage : Storage
        Folder of the store.
    database : VehicleDatabase or None
        DBC and layout with which the store must have been made; None: any.

    Returns
    -------
    StoreIdentity or None
        The identity; None if there is no store.

    Raises
    ------
    FleetError
        If the file is damaged or holds impossible values, or the store has another version, layout, DBC or length of
        blocks.
    """
    content, where = storage.read_if_there(FILE), f"{storage.url}/{FILE}"
    if content is None:
        return None
    try:
        raw = msgspec.json.decode(content)
        version = raw.get("schema_version") if isinstance(raw, dict) else None
        if version != SCHEMA_VERSION:
            raise FleetError(
                f"{where}: schema version {version!r}, expected {SCHEMA_VERSION}; summarise the drives again"
            )
        identity = msgspec.convert(raw, StoreIdentity)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, DriveError) as error:
        raise FleetError(f"{where}: not a store of summaries: {error}; summarise the drives again") from None
    if database is None:
        return identity
    layout = database.layout
    for what, its, mine in (
        (f"another layout than {layout.path}", identity.layout_sha256, layout.digest),
        (f"another DBC than {layout.dbc_path}", identity.dbc_sha256, database.digest),
        (f"blocks of {identity.block_s:g} s, not {BLOCK_S:g} s", identity.block_s, BLOCK_S),
    ):
        if its != mine:
            raise FleetError(f"{where}: made with {what}; summarise the drives again, into another store")
    return identity
