"""What the tests of the signers' commands have in common."""

import resource
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from ecu_node.trust.key_set import KeySet, check_key_set


def by(keys: Path, names: Iterable[str]) -> list[object]:
    return [item for name in names for item in ("--key", keys / f"{name}.key")]


def key_set(keys: Path) -> KeySet:
    return check_key_set(msgspec.json.decode((keys / "set.json").read_bytes(), type=KeySet), "k")


def require_one_line(done: tuple[int, str, str], words: str, code: int = 1) -> None:
    assert (done[0], done[1]) == (code, ""), done
    assert done[2].startswith("calibrator: "), done
    assert done[2][:-1].isprintable(), done
    assert words in done[2]


@contextmanager
def full_disk(free_bytes: int) -> Iterator[None]:
    """No file that is written may have more bytes, as on a disk that becomes full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
