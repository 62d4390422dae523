"""Bundles that were changed anywhere: each is refused in one line, and nothing of the vehicle changes.

``HV_BUNDLES=1000000 pytest -n auto tests/update/test_changed_bundles.py`` tries that many bundles.
"""

import json
import lzma
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from tuf.api.metadata import Metadata

from ecu_node.core.status import UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.update.client import update
from tests.ecu_node.vehicles import places
from tests.update.repo import Repo

BUNDLES = int(os.environ.get("HV_BUNDLES", "300"))
AT_A_TIME = min(BUNDLES, 1_000)
VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.sampled_from(["9" * 5000])
"""Values that an attacker might write in the place of another."""


def files_of(bundle: bytes) -> dict[str, str]:
    return msgspec.json.decode(lzma.decompress(bundle), type=dict[str, str])


def signed_in(bundle: bytes) -> dict[str, Any]:
    """What is signed in the metadata that counts; a space between two values changes nothing of it."""
    files = files_of(bundle)
    names = [name for name in files if name.startswith("metadata") and "root" not in name]
    return {name: Metadata.from_bytes(files[name].encode()).signed for name in names}


@st.composite
def changed_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """A piece is replaced, cut out, repeated or put in, or the end is missing."""
    at, length = draw(st.integers(0, len(content) - 1)), draw(st.sampled_from((0, 1, 2, 16, 200, len(content))))
    piece = content[at : at + length]
    return content[:at] + draw(st.binary(max_size=16) | st.just(2 * piece)) + content[at + length :]


@st.composite
def changed_json(draw: st.DrawFn, text: str) -> str:
    """A value is changed, removed, or put in the place of another."""
    document = json.loads(text)
    (container, key), (other, other_key) = (draw(st.sampled_from([*places(document)])) for _ in range(2))
    if draw(st.booleans()):
        container[key] = draw(VALUES | st.just(json.loads(json.dumps(other[other_key]))))
    else:
        del container[key]
    return json.dumps(document)


@st.composite
def changed_bundles(draw: st.DrawFn, first: bytes, second: bytes) -> bytes:
    """The second bundle, changed as it is or in one of its files, which may also be that of the first bundle."""
    old, files = files_of(first), files_of(second)
    name, kind = draw(st.sampled_from(sorted(files))), draw(st.sampled_from(("bundle", "bytes", "json", "old", "none")))
    if kind == "bundle":
        return draw(changed_bytes(second))
    if kind == "none":
        del files[name]
    elif kind == "bytes":
        files[name] = draw(changed_bytes(files[name].encode())).decode(errors="replace")
    elif kind == "json":
        files[name] = draw(changed_json(files[name]))
    else:
        kin = [text for key, text in old.items() if key.partition(".")[2] == name.partition(".")[2]]
        files[name] = draw(st.sampled_from(kin or sorted(old.values())))
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

    @settings(max_examples=AT_A_TIME, suppress_health_check=[HealthCheck.too_slow])
    @given(content=changed_bundles(first, second))
    def require_refused(content: bytes) -> None:
        assume(content not in (first, second))
        bundle.write_bytes(content)
        try:
            update(state, str(bundle), database, datetime.now(UTC))
        except UnfitError as error:
            said.append(str(error))
            assert said[-1].isprintable(), "more than one line"
            assert (state / "state.json").read_bytes() == held
        else:
            (state / "state.json").write_bytes(held)
            assert signed_in(content) == signed_in(second), "accepted"

    require_refused()
    for words in ("not a whole bundle", "was signed by", "older than", "is not in the bundle", "Failed to deserialize"):
        assert any(words in text for text in said), f"no change came as far as {words!r} in part {part}"
