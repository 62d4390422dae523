"""Keys by name: a private key in a PEM file, or a public one with the URI of where its private half is kept.

    anna.key                        PEM, PKCS #8; its passphrase, if it has one, in $CALIBRATOR_KEY_PASSPHRASE
    anna.pub=hsm:2                  PKCS #11, such as a YubiKey; $PYKCS11LIB names its library
    release.pub=awskms:KEY          cloud key services; also gcpkms:, azurekms:, hv: (HashiCorp Vault)

What stands behind the equals sign is a signer URI of securesystemslib, which says which package each kind needs.
"""

import os
import stat
from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import load_pem_private_key, load_pem_public_key
from securesystemslib.exceptions import UnsupportedLibraryError
from securesystemslib.signer import CryptoSigner, Signer, SSlibKey

from ecu_node.documents import read_user_file
from ecu_node.errors import UserError

__all__ = ["PASSPHRASE_VARIABLE", "public_key_of", "signer_of"]

PASSPHRASE_VARIABLE = "CALIBRATOR_KEY_PASSPHRASE"  # noqa: S105  # its name
_LARGEST_KEY_BYTES = 100_000


def public_key_of(path: Path) -> SSlibKey:
    """Read a public key (PEM); raises UserError if it is none."""
    try:
        return SSlibKey.from_crypto(load_pem_public_key(read_user_file(path, largest_bytes=_LARGEST_KEY_BYTES)))
    except OSError as error:
        raise UserError(f"{path}: cannot read the public key: {error.strerror}") from None
    except (ValueError, UnsupportedAlgorithm):
        raise UserError(f"{path}: no public key (PEM) of Ed25519, ECDSA or RSA; give NAME.pub of a signer") from None


def signer_of(text: str) -> Signer:
    """Open a private key.

    Parameters
    ----------
    text : str
        Path of a PEM file, or PUBLIC.pem=URI.

    Returns
    -------
    Signer
        Signs in the name of the key's owner.

    Raises
    ------
    UserError
        If the key cannot be had, others may read its file, or its passphrase is another one.
    """
    public, is_uri, uri = text.partition("=")
    if is_uri:
        try:
            return Signer.from_priv_key_uri(uri, public_key_of(Path(public)))
        except (ValueError, OSError, UnsupportedLibraryError) as error:
            raise UserError(f"{text}: the key cannot be used: {error}") from None
    path = Path(text)
    try:
        content = read_user_file(path, largest_bytes=_LARGEST_KEY_BYTES)
        rights = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise UserError(f"{path}: cannot read the private key: {error.strerror}; give NAME.key of a signer") from None
    passphrase = os.environ.get(PASSPHRASE_VARIABLE)
    secret = os.fsencode(passphrase) if passphrase and b"ENCRYPTED" in content else None
    try:
        signer = CryptoSigner(load_pem_private_key(content, secret))
    except TypeError:
        raise UserError(
            f"{path}: the private key is encrypted; give its passphrase in ${PASSPHRASE_VARIABLE}"
        ) from None
    except (ValueError, UnsupportedAlgorithm):
        why = f"it is damaged, or ${PASSPHRASE_VARIABLE} is not its passphrase" if secret else "it is none, or damaged"
        raise UserError(f"{path}: cannot be used as a private key (PEM, PKCS #8): {why}") from None
    if rights & 0o066:
        raise UserError(
            f"{path}: others than its owner can read or write this private key (mode {rights:03o}); 'chmod 600' it, "
            f"and if somebody may have read it, make another key"
        )
    return signer
