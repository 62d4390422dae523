"""Signers, and what they sign, for the tests of trust."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from securesystemslib.signer import CryptoSigner

from calibrator.signing.key_files import NamedKey, new_key, read_public_key, read_signer
from calibrator.signing.statements import signed_statement
from ecu_node.parameters import VehicleParameters
from ecu_node.trust.key_set import KeySet
from ecu_node.trust.statements import Revocation, SignedParameters
from tests.ecu_node.vehicles import LAYOUT

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
VEHICLE = "v1"
Run = Callable[..., tuple[int, str, str]]
"""A command line, and what comes of it: exit code, output, errors."""


def time_text(when: datetime) -> str:
    return when.strftime("%Y-%m-%dT%H:%M:%SZ")


@dataclass(frozen=True)
class Signers:
    """Three signers, two of whom are needed."""

    signers: dict[str, CryptoSigner]
    public: dict[str, NamedKey]

    def keys(self, names: str = "abc", *, threshold: int = 2, version: int = 1) -> KeySet:
        found = [self.public[name] for name in names]
        return KeySet(version=version, threshold=threshold, keys={item.keyid: item.key for item in found})

    def of(self, names: Sequence[str]) -> list[CryptoSigner]:
        return [self.signers[name] for name in names]

    def parameters(
        self,
        parameters: VehicleParameters,
        sequence: int,
        *,
        by: str = "ab",
        not_before: datetime = NOW,
        expires: datetime | None = None,
        allow_large_step: bool = False,
    ) -> bytes:
        statement = SignedParameters(
            sequence=sequence,
            not_before=time_text(not_before),
            expires=time_text(expires if expires is not None else not_before + timedelta(days=365)),
            allow_large_step=allow_large_step,
            parameters=parameters,
        )
        return signed_statement(statement, self.of(by))

    def revocation(self, sequence: int, *revokes: int, by: str = "ab", vehicle: str = VEHICLE) -> bytes:
        statement = Revocation(
            vehicle=vehicle, sequence=sequence, created=time_text(NOW), revokes=list(revokes), why="wrong drives"
        )
        return signed_statement(statement, self.of(by))

    def key_set(self, keys: KeySet, *, by: str = "ab") -> bytes:
        return signed_statement(keys, self.of(by))


def make_signers(folder: Path) -> Signers:
    """Keys of signers a, b and c, and of d, whom nobody trusts."""
    paths = {name: new_key(name, folder, None) for name in "abcd"}
    return Signers(
        signers={name: read_signer(private, None) for name, (private, _) in paths.items()},
        public={name: read_public_key(public) for name, (_, public) in paths.items()},
    )


def on(state: Path) -> list[object]:
    """Options of a command for a vehicle."""
    return ["--state", state, "--layout", LAYOUT]
