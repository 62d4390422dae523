"""Bundles that were changed, each given to a vehicle: none is accepted, each is refused in one line.

    python -m bench.update_fuzz --bundles 1000000        (in tools/)

Three of four are changed as they are: bytes, pieces, length. The others are taken apart, changed in one file (bytes,
pieces, values of the JSON, files exchanged between two publications) and packed anew, so that they come as far as TUF's
client and our own checks. What is drawn depends on the seed alone. A process per core has a vehicle of its own, whose
state lies in memory; nothing else differs from ``ecu-node update``.
"""

import argparse
import functools
import itertools
import json
import lzma
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Any

import msgspec
from msgspec.structs import replace
from tuf.api.metadata import Metadata

from bench.published import Publisher
from bench.row import LAYOUT
from bench.true_parameters import true_parameters
from calibrator.terminal.progress import shown
from ecu_node.core.status import UnfitError
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, encode_parameters
from ecu_node.update.client import provision, update

__all__ = ["Vehicle", "WrongAnswerError", "fuzz"]

_MEMORY = Path("/dev/shm")  # noqa: S108
_CHUNK = 1000
"""Bundles that a process takes at a time."""
_ODD: tuple[Any, ...] = (None, True, -1, 0, 2**31, 1e308, "", "x", "é\ud800", "../../x", [], {}, [[]], "9" * 5000)
"""Values that somebody might write in the place of others."""


class WrongAnswerError(Exception):
    """A changed bundle was accepted, or refused otherwise than in one line."""


class Vehicle:
    """A vehicle that took a first publication, and the bundles of the first and of a second one.

    Parameters
    ----------
    folder : Path
        Empty; for repository and state.
    """

    def __init__(self, folder: Path) -> None:
        self._state, self._bundle = folder / "state", folder / "bundle.json.xz"
        self._database, self.bundles = read_database(read_layout(LAYOUT)), list[bytes]()
        publisher = Publisher(folder / "repository")
        for drift in (0.05, 0.06):
            branch = BranchParameters(drift=drift, offset_a=1.0, apply=True)
            parameters = true_parameters(self._database, {"battery": branch})
            for name in ("bench", "other"):
                (folder / f"{name}.json").write_bytes(encode_parameters(replace(parameters, vehicle=name), "fuzz"))
            publisher.add([folder / "bench.json", folder / "other.json"])
            publisher.publish()
            self.bundles.append(publisher.bundle("bench"))
            if drift == 0.05:
                provision(self._state, "bench", publisher.root, datetime.now(UTC))
                self.update(self.bundles[0])
        self._files = [msgspec.json.decode(lzma.decompress(item), type=dict[str, str]) for item in self.bundles]
        self._held = (self._state / "state.json").read_bytes()

    def changed(self, rng: Random) -> bytes:
        """The second bundle, changed in one place or a few."""
        if rng.random() < 0.75:
            return changed_bytes(rng, self.bundles[1])
        first, files = self._files
        texts = dict(files)
        name, kind = rng.choice(sorted(texts)), rng.randrange(4)
        if kind == 0:
            texts[name] = changed_bytes(rng, texts[name].encode()).decode(errors="replace")
        elif kind == 1:
            texts[name] = json.dumps(changed_value(rng, json.loads(texts[name])))
        elif kind == 2:  # of the first publication: the file of this name, whatever its version
            old = {key.partition(".")[2]: text for key, text in first.items() if "root" not in key}
            texts[name] = old.get(name.partition(".")[2], rng.choice(list(first.values())))
        else:
            del texts[name]
        packed = json.dumps(texts, ensure_ascii=False).encode(errors="replace")
        return lzma.compress(packed, check=lzma.CHECK_SHA256, preset=0)  # as bundle_bytes, but quickly

    def update(self, content: bytes) -> str:
        """What the vehicle says of a bundle."""
        self._bundle.write_bytes(content)
        return update(self._state, str(self._bundle), self._database, datetime.now(UTC))

    def require_refused(self, content: bytes, where: str) -> bool:
        """Give a bundle to the vehicle; False if it says the same as the second bundle, signatures included."""
        state = self._state / "state.json"
        try:
            text = self.update(content)
        except UnfitError as error:
            if not str(error).isprintable():
                raise WrongAnswerError(f"{where}: not one line: {str(error)!r}") from None
            if state.read_bytes() != self._held:
                raise WrongAnswerError(f"{where}: refused, but the state has changed: {content.hex()}") from None
            return True
        except Exception as error:
            raise WrongAnswerError(f"{where}: {error!r}: {content.hex()}") from error
        state.write_bytes(self._held)
        if self._is_same(content):
            return False
        raise WrongAnswerError(f"{where}: accepted ({text}): {content.hex()}")

    def forget_decisions(self) -> None:
        """Empty the log, which lies in memory here."""
        (self._state / "decisions.log").write_bytes(b"")

    def _is_same(self, content: bytes) -> bool:
        """Whether TUF reads all that is signed in the files that count as before, as where a space was added."""

        def signed(texts: dict[str, str]) -> dict[str, Any]:
            newest = {name: text for name, text in texts.items() if name.startswith("metadata") and "root" not in name}
            return {name: Metadata.from_bytes(text.encode()).signed for name, text in newest.items()}

        files = msgspec.json.decode(lzma.decompress(content), type=dict[str, str])
        return signed(files) == signed(self._files[1])


def changed_bytes(rng: Random, content: bytes) -> bytes:
    """Bytes with a bit turned, a piece replaced, cut out, repeated or put in, or the end missing."""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        place = rng.randrange(max(len(found), 1))
        length = min(rng.choice((1, 2, 16, 200)), len(found) - place)
        piece = found[place : place + length]
        others = (b"", 2 * piece, rng.randbytes(length), rng.randbytes(length) + piece)
        if rng.random() < 0.2:
            del found[place:]
        elif rng.random() < 0.2 and found:
            found[place] ^= 1 << rng.randrange(8)
        else:
            found[place : place + length] = rng.choice(others)
    return bytes(found)


def changed_value(rng: Random, document: Any) -> Any:
    """A JSON document with one value changed, removed, or put in the place of another."""
    places = list[tuple[Any, Any]]()

    def collect(value: Any) -> None:
        keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else []
        for key in keys:
            places.append((value, key))
            collect(value[key])

    collect(document)
    container, key = rng.choice(places)
    other, other_key = rng.choice(places)
    values = [rng.choice(_ODD), json.loads(json.dumps(other[other_key]))]
    if isinstance(container[key], str):
        values.append(changed_bytes(rng, container[key].encode()).decode(errors="replace"))
    elif isinstance(container[key], int):
        values.append(container[key] + rng.choice((-1, 1, 2**31)))
    if rng.random() < 0.25:
        del container[key]
    else:
        container[key] = rng.choice(values)
    return document


def fuzz(numbers: Iterable[int], folder: Path, seed: int = 0) -> int:
    """Give changed bundles to a vehicle.

    Parameters
    ----------
    numbers : iterable of int
        Which ones; each gives the same changes whenever it is drawn.
    folder : Path
        Where this process keeps its vehicle.
    seed : int
        For others.

    Returns
    -------
    int
        How many were refused; one that says the same as before is drawn anew.

    Raises
    ------
    WrongAnswerError
        If one was accepted, changed the state, or was refused otherwise than in one line.
    """
    vehicle, refused = _vehicle(folder), 0
    for number in numbers:
        for attempt in itertools.count():
            content = vehicle.changed(Random(f"{seed} {number} {attempt}"))
            where = f"seed {seed}, bundle {number}, attempt {attempt}"
            if content not in vehicle.bundles and vehicle.require_refused(content, where):
                break
        refused += 1
    vehicle.forget_decisions()
    return refused


@functools.cache
def _vehicle(folder: Path) -> Vehicle:
    return Vehicle(Path(tempfile.mkdtemp(dir=folder)))


def main() -> None:
    """Run, and say how many were refused."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bundles", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    options = parser.parse_args()
    parts = [range(first, min(first + _CHUNK, options.bundles)) for first in range(0, options.bundles, _CHUNK)]
    in_memory = _MEMORY if os.access(_MEMORY, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=in_memory) as name, multiprocessing.Pool(options.processes) as pool:
        refused = pool.imap_unordered(functools.partial(fuzz, folder=Path(name), seed=options.seed), parts)
        try:
            done = sum(shown(refused, "fuzz", len(parts), "thousand bundles"))
        except WrongAnswerError as error:
            sys.exit(f"{error}")
    print(f"{done} changed bundles refused, each in one line")


if __name__ == "__main__":
    main()
