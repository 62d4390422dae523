"""A repository of signed parameters whose private keys are kept in memory."""

from collections.abc import Iterable
from pathlib import Path

from securesystemslib.signer import CryptoSigner

from calibrator.repository.repository import ROLES, NewKeys, Repository

__all__ = ["Publisher"]


class Publisher:
    """A new repository in a new or empty folder, and the people who all sign it, each with a key for every role."""

    def __init__(self, folder: Path, people: int = 1) -> None:
        self.folder, self.root = folder, folder / "metadata" / "1.root.json"
        signers = {role: [CryptoSigner.generate_ed25519() for _ in range(people)] for role in ROLES}
        keys = {role: NewKeys([signer.public_key for signer in some], people) for role, some in signers.items()}
        self._signers = [signer for some in signers.values() for signer in some]
        Repository.create(folder, keys)

    def add(self, files: Iterable[Path]) -> None:
        """Stage parameter files, to be signed and published later."""
        Repository(self.folder).add(files, days=365, allow_large_step=False)

    def publish(self) -> None:
        """Sign what is staged, and let vehicles see it."""
        repository = Repository(self.folder)
        for _ in repository.sign(self._signers):
            pass
        repository.publish(self._signers)

    def bundle(self, vehicle: str) -> bytes:
        """Return what one vehicle needs of the repository."""
        return Repository(self.folder).bundle(vehicle)
