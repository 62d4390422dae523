"""Identity of a store: its summaries add up only if branches, inputs, filters and time base are the same."""

import hashlib
from typing import Annotated

import msgspec

from calibrator.drive import Equipment
from calibrator.errors import DriveError, FleetError
from calibrator.files.storage import Storage
from calibrator.summaries.filter_bank import FilterBank
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

SCHEMA_VERSION = 5
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
    equipment : Equipment
        Branches and inputs of the fleet, and notices on those of the layout that the store does not use.
    bank : FilterBank
        Filters of the fleet inputs.
    buckets : int
        Number of parts that the vehicles are spread over.
    fleet : str
        Name of the fleet.
    """

    schema_version: int = SCHEMA_VERSION
    layout: str
    layout_sha256: str
    dbc_sha256: str
    equipment: Equipment
    bank: FilterBank
    buckets: Annotated[int, msgspec.Meta(ge=FEWEST_BUCKETS, le=MOST_BUCKETS)]
    fleet: str


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
    layout, wanted = database.layout, 1 << max(vehicles // VEHICLES_PER_BUCKET, 1).bit_length()
    return StoreIdentity(
        layout=layout.name,
        layout_sha256=layout.digest,
        dbc_sha256=database.digest,
        equipment=equipment,
        bank=bank or FilterBank(input_names=equipment.fleet_inputs, period_s=layout.period_s),
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
        If the file is damaged or holds impossible values, or the store has another version, layout or DBC.
    """
    content, where = storage.read_if_there(FILE), f"{storage.url}/{FILE}"
    if content is None:
        return None
    try:
        version = msgspec.json.decode(content, type=_Versioned).schema_version
        if version != SCHEMA_VERSION:
            raise FleetError(
                f"{where}: schema version {version!r}, expected {SCHEMA_VERSION}; summarise the drives again"
            )
        identity = msgspec.json.decode(content, type=StoreIdentity)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, DriveError) as error:
        raise FleetError(f"{where}: not a store of summaries: {error}; summarise the drives again") from None
    if database is None:
        return identity
    layout = database.layout
    for what, its, mine in (
        (f"another layout than {layout.path}", identity.layout_sha256, layout.digest),
        (f"another DBC than {layout.dbc_path}", identity.dbc_sha256, database.digest),
    ):
        if its != mine:
            raise FleetError(f"{where}: made with {what}; summarise the drives again, into another store")
    return identity


class _Versioned(msgspec.Struct):
    """What the identity files of all schema versions have in common."""

    schema_version: int
