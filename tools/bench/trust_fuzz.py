"""Signed files that were changed in many ways, each given to a vehicle: none is accepted, each is refused in one line.

    python -m bench.trust_fuzz --files 1000000

Each goes through the whole judgement: envelope, signatures, statement, order, time, fit, limits, step; nothing is
written. Beside them some statements are changed and then signed anew by the right signers: these may be accepted, and
must crash nothing either. What is drawn depends on the seed alone.
"""

import argparse
import base64
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Any

import rfc8785
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from securesystemslib.signer import CryptoSigner, Signer

from bench.true_parameters import true_parameters
from bench.trust_fuzz_mutations import MUTATIONS, changed_document
from calibrator.signing.statements import signed_anew, signed_statement
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters
from ecu_node.trust.activation import accept, conclude
from ecu_node.trust.envelope import Envelope
from ecu_node.trust.judgement import Arrival, judge_arrival
from ecu_node.trust.key_set import KeySet, PublicKey
from ecu_node.trust.provision import provision
from ecu_node.trust.statements import Revocation, SignedParameters, Statement

__all__ = ["Vehicle", "WrongAnswerError", "fuzz"]

FILES_PER_ROUND = 1_000
_SIGNED_ANEW = 0.05
"""For each changed file so many changed statements are signed anew. [1]"""
_LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
_NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


class WrongAnswerError(Exception):
    """A changed file was accepted, or refused otherwise than in one line."""


def fuzz(files: int, seed: int = 0) -> Iterator[int]:
    """Give changed files to a vehicle.

    Parameters
    ----------
    files : int
        How many in all; those that came out as they were do not count.
    seed : int
        Of all that is drawn.

    Yields
    ------
    int
        How many were refused as they should so far.

    Raises
    ------
    WrongAnswerError
        At the first one that was not.
    """
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        vehicle = Vehicle(Path(folder))
        done = 0
        while done < files:
            rng = Random(f"{seed} {done}")  # noqa: S311  # no secrets
            where = f"seed {seed}, round of file {done}"
            count = min(FILES_PER_ROUND, files - done)
            for number in range(count):
                vehicle.require_refused(vehicle.changed(rng), f"{where}, file {number}")
                if rng.random() < _SIGNED_ANEW:
                    vehicle.require_answer(vehicle.signed_anew(rng), f"{where}, signed anew at file {number}")
            done += count
            yield done


@dataclass(frozen=True)
class _Samples:
    """Signed files, all of them valid, and what to sign with."""

    files: list[bytes]
    signers: dict[str, Signer]
    keys: KeySet


class Vehicle:
    """A vehicle with parameters in force, and files that were signed for it.

    Parameters
    ----------
    folder : Path
        For its state.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "state"
        self._database = read_database(read_layout(_LAYOUT))
        self._samples = _samples(self._database)
        provision(self._folder, "bench", self._samples.keys, _NOW)
        accept(self._folder, self._samples.files[0], "first", self._database, _NOW)
        self._state = conclude(self._folder, 1, passed=True, text="fuzz", now=_NOW)
        self.valid = tuple(self._samples.files)
        for number, file in enumerate(self._samples.files[1:]):
            if not self.answer(file)[0]:
                raise WrongAnswerError(f"sample {number} is not accepted: {self.answer(file)[1]}")

    def changed(self, rng: Random) -> bytes:
        """A file that is none of the valid ones."""
        file = rng.choice(self._samples.files)
        while file in self.valid:
            for _ in range(rng.choice((1, 1, 1, 2))):
                before = file if file in self.valid else rng.choice(self._samples.files)
                file = rng.choice(MUTATIONS)(rng, before, rng.choice(self._samples.files))
        return file

    def signed_anew(self, rng: Random) -> bytes:
        """A changed statement that the right signers vouch for."""
        envelope = json.loads(rng.choice(self._samples.files))
        statement: Any = json.loads(base64.b64decode(envelope["payload"]))
        if "parameters" in statement and rng.random() < 0.5:
            parameters = statement["parameters"]
            parameters["branches"] = changed_document(rng, parameters["branches"])
        else:
            statement = changed_document(rng, statement)
        try:
            payload = rfc8785.dumps(statement)
        except (rfc8785.CanonicalizationError, ValueError, RecursionError):
            payload = json.dumps(statement).encode(errors="replace")
        unsigned = Envelope(
            payload=base64.b64encode(payload).decode(), payloadType=envelope["payloadType"], signatures=[]
        )
        return signed_anew(unsigned, [self._samples.signers[name] for name in "ab"])

    def answer(self, file: bytes) -> tuple[bool, str]:
        """Whether a file would be accepted, and what is said of it."""
        try:
            return True, judge_arrival(Arrival(self._folder, self._state, file, "f", _NOW), self._database).text
        except UserError as error:
            return False, str(error)

    def require_answer(self, file: bytes, where: str) -> bool:
        """Give a file to the vehicle; whether it would be accepted. Raises WrongAnswerError if that is not said."""
        try:
            accepted, text = self.answer(file)
        except Exception as error:  # it is what is looked for
            raise WrongAnswerError(f"{where}: {error!r}: {_shown(file)}") from error
        if not accepted and not text.isprintable():
            raise WrongAnswerError(f"{where}: not one line: {text!r}: {_shown(file)}")
        return accepted

    def require_refused(self, file: bytes, where: str) -> None:
        """Give a file to the vehicle that it must refuse; raises WrongAnswerError if it does not."""
        if self.require_answer(file, where):
            raise WrongAnswerError(f"{where}: accepted: {_shown(file)}")


def _samples(database: VehicleDatabase) -> _Samples:
    signers: dict[str, CryptoSigner] = {}
    for name in "abcd":
        secret = hashlib.sha256(f"signer {name}".encode()).digest()
        signers[name] = CryptoSigner(Ed25519PrivateKey.from_private_bytes(secret))
    keys = _key_set(signers, "abc", 1)
    statements: list[tuple[Statement, str]] = [
        (_parameters(database, 1, 0.01), "ab"),
        (_parameters(database, 2, 0.02), "ab"),
        (_parameters(database, 3, -0.01), "ac"),
        (Revocation(vehicle="bench", sequence=4, created=_text(0), revokes=[1], why="fuzz"), "bc"),
        (_key_set(signers, "abd", 2), "ab"),
    ]
    files = [signed_statement(statement, [signers[name] for name in by]) for statement, by in statements]
    return _Samples(files, dict(signers), keys)


def _key_set(signers: dict[str, CryptoSigner], names: str, version: int) -> KeySet:
    public = {name: signers[name].public_key for name in names}
    return KeySet(
        version=version,
        threshold=2,
        keys={key.keyid: PublicKey(name=name, ed25519=key.keyval["public"]) for name, key in public.items()},
    )


def _parameters(database: VehicleDatabase, sequence: int, drift: float) -> SignedParameters:
    branches = {"battery": BranchParameters(drift=drift, offset_a=1.5, apply=True)}
    return SignedParameters(
        sequence=sequence, not_before=_text(-1), expires=_text(1), parameters=true_parameters(database, branches)
    )


def _text(years: int) -> str:
    return _NOW.replace(year=_NOW.year + years).strftime("%Y-%m-%dT%H:%M:%SZ")


def _shown(file: bytes) -> str:
    return base64.b64encode(file).decode()


def main() -> int:
    """Try as many files as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--files", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    start_s = time.monotonic()
    done = 0
    try:
        for done in fuzz(arguments.files, arguments.seed):
            if done % (50 * FILES_PER_ROUND) == 0:
                print(f"{done} files, {done / (time.monotonic() - start_s):.0f} files/s", file=sys.stderr, flush=True)
    except WrongAnswerError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{done} changed files refused, each in one line, {done / (time.monotonic() - start_s):.0f} files/s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
