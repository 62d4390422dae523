"""Bundles that were changed anywhere: each is refused in one line, and nothing of the vehicle changes.

``HV_BUNDLES=1000000 pytest -n auto tests/update/test_changed_bundles.py`` tries so many.
"""

import json
import lzma
import os
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest
from tuf.api.metadata import Metadata

from ecu_node.core.status import UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.update.client import update
from tests.update.repo import Repo

BUNDLES = int(os.environ.get("HV_BUNDLES", "300"))
AT_A_TIME = min(BUNDLES, 1_000)
VALUES: tuple[Any, ...] = (None, True, 0, -1, 2**70, 0.5, float("inf"), "", "\u03bc\n", "9" * 5000, [], {})
"""What somebody might write in the place of another value."""


def files_of(bundle: bytes) -> dict[str, str]:
    return msgspec.json.decode(lzma.decompress(bundle), type=dict[str, str])


def signed_in(bundle: bytes) -> dict[str, Any]:
    """What is signed in the metadata that counts; a space between two values changes nothing of it."""
    names = [name for name in files_of(bundle) if name.startswith("metadata") and "root" not in name]
    return {name: Metadata.from_bytes(files_of(bundle)[name].encode()).signed for name in names}


def changed_bytes(rng: Random, content: bytes) -> bytes:
    """A piece is replaced, cut out, repeated or put in, or the end is missing."""
    at, length = rng.randrange(len(content)), rng.choice((0, 1, 2, 16, 200, len(content)))
    piece = content[at : at + length]
    return content[:at] + rng.choice((b"", rng.randbytes(rng.randrange(16)), 2 * piece)) + content[at + length :]


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every container of a JSON document with each of its keys."""
    for key in range(len(value)) if isinstance(value, list) else list(value) if isinstance(value, dict) else ():
        yield value, key
        yield from places(value[key])


def changed_json(rng: Random, text: str) -> str:
    """A value is changed, removed, or put in the place of another."""
    document = json.loads(text)
    (container, key), (other, other_key) = rng.choices([*places(document)], k=2)
    if rng.random() < 0.5:
        container[key] = rng.choice((*VALUES, json.loads(json.dumps(other[other_key]))))
    else:
        del container[key]
    return json.dumps(document)


def changed_bundle(rng: Random, first: bytes, second: bytes) -> bytes:
    """The second bundle, changed as it is or in one of its files, which may also be that of the first bundle."""
    old, files = files_of(first), files_of(second)
    name, kind = rng.choice(sorted(files)), rng.choice(("bundle", "bytes", "json", "old"))
    if kind == "bundle":
        return changed_bytes(rng, second)
    if kind == "bytes":
        files[name] = changed_bytes(rng, files[name].encode()).decode(errors="replace")
    elif kind == "json":
        files[name] = changed_json(rng, files[name])
    else:
        kin = [text for key, text in old.items() if key.partition(".")[2] == name.partition(".")[2]]
        files[name] = rng.choice(kin or sorted(old.values()))
    packed = json.dumps(files, ensure_ascii=False).encode(errors="replace")
    return lzma.compress(packed, check=lzma.CHECK_SHA256, preset=0)  # as bundle_bytes, but quickly


@pytest.mark.parametrize("part", range(-(-BUNDLES // AT_A_TIME)))
def test_changed_bundle_is_refused_in_one_line_and_changes_nothing(
    part: int, offered: Repo, other: VehicleParameters, database: VehicleDatabase, tmp_path: Path
) -> None:
    repo, state, said = offered.copy(tmp_path), tmp_path / "state", list[str]()
    shutil.copytree(offered.folder / "in force", state)
    first = repo.bundle().read_bytes()
    repo.offer(other)
    second, bundle, held = repo.bundle().read_bytes(), tmp_path / "v1.json.xz", (state / "state.json").read_bytes()
    for seed in range(part * AT_A_TIME, (part + 1) * AT_A_TIME):
        content = changed_bundle(Random(seed), first, second)
        bundle.write_bytes(content)
        try:
            update(state, str(bundle), database, datetime.now(UTC))
        except UnfitError as error:
            said.append(str(error))
            assert said[-1].isprintable(), f"more than one line, seed {seed}"
            assert (state / "state.json").read_bytes() == held, f"changed, seed {seed}"
        else:
            (state / "state.json").write_bytes(held)
            assert signed_in(content) == signed_in(second), f"accepted, seed {seed}"
    for words in ("not a whole bundle", "was signed by", "older than", "is not in the bundle", "Failed to deserialize"):
        assert any(words in text for text in said), f"no change came as far as {words!r} in part {part}"
