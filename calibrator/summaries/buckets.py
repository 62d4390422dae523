"""In which of a fixed number of files a vehicle is: a hash of its name, the same on every machine."""

import hashlib

__all__ = ["bucket_of"]

_HASH_BYTES = 8


def bucket_of(vehicle: str, buckets: int) -> int:
    """Bucket of a vehicle: the same on every machine, and independent of the other vehicles.

    Parameters
    ----------
    vehicle : str
        Name.
    buckets : int
        Number of buckets of the store.

    Returns
    -------
    int
        From 0 to buckets - 1.
    """
    digest = hashlib.blake2b(vehicle.encode(), digest_size=_HASH_BYTES).digest()
    return int.from_bytes(digest, "big") % buckets
