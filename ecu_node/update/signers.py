"""Opens keys by name: a private key in a PEM file, or a public key with the URI of the place of its private half.

    anna.key                        PEM, PKCS #8; its passphrase, if it has one, in $CALIBRATOR_KEY_PASSPHRASE or typed
    anna.pub=hsm:2                  PKCS #11, such as a YubiKey; $PYKCS11LIB names its library; the PIN likewise
    release.pub=awskms:KEY          cloud key services; also gcpkms:, azurekms:, hv: (HashiCorp Vault)

After the equals sign comes a signer URI of securesystemslib, which says which package each kind needs.
"""

import os
import stat
import sys
from collections.abc import Iterator
from contextlib import suppress
from getpass import getpass
from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import load_pem_private_key, load_pem_public_key
from securesystemslib.signer import SIGNER_FOR_URI_SCHEME, CryptoSigner, Signer, SSlibKey

from ecu_node.documents import read_user_file
from ecu_node.errors import UserError

__all__ = ["PASSPHRASE_VARIABLE", "public_key_of", "signer_of"]

PASSPHRASE_VARIABLE = "CALIBRATOR_KEY_PASSPHRASE"  # noqa: S105  # its name
_LARGEST_KEY_BYTES = 100_000


def public_key_of(path: Path) -> SSlibKey:
    """Read a public key (PEM); raise UserError if the file holds none."""
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
        If the key cannot be loaded, others may read or write its file, or its passphrase is wrong.
    """
    public, is_uri, uri = text.partition("=")
    if is_uri:
        key = public_key_of(Path(public))
        try:
            return Signer.from_priv_key_uri(uri, key, lambda what: next(_secrets(f"{what} of {text}"), ""))
        except Exception as error:  # noqa: BLE001 (each device and service has errors of its own)
            known = ", ".join(f"{scheme}:" for scheme in SIGNER_FOR_URI_SCHEME)
            raise UserError(
                f"{text}: the key cannot be used: {type(error).__name__}: {error}; a URI of {known} is expected"
            ) from None
    path = Path(text)
    try:
        content = read_user_file(path, largest_bytes=_LARGEST_KEY_BYTES)
        rights = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise UserError(f"{path}: cannot read the private key: {error.strerror}; give NAME.key of a signer") from None
    is_encrypted = b"ENCRYPTED" in content
    secret: str | None = None
    for secret in _secrets(f"passphrase of {path}") if is_encrypted else (None,):
        with suppress(ValueError, TypeError, UnsupportedAlgorithm):
            signer = CryptoSigner(load_pem_private_key(content, os.fsencode(secret) if secret else None))
            break
    else:
        why = "none, or damaged"
        if secret:
            why = f"it is encrypted, and the passphrase (${PASSPHRASE_VARIABLE}, or typed) does not fit it"
        elif is_encrypted:
            why = f"it is encrypted; give its passphrase in ${PASSPHRASE_VARIABLE}"
        raise UserError(f"{path}: cannot be used as a private key (PEM, PKCS #8): {why}")
    if rights & 0o066:
        raise UserError(
            f"{path}: others than its owner can read or write this private key (mode {rights:03o}); 'chmod 600' it, "
            f"and if somebody may have read it, make another key"
        )
    return signer


def _secrets(what: str) -> Iterator[str]:
    """Yield a passphrase or PIN: first that of the environment, then what a person types at the terminal, once."""
    if secret := os.environ.get(PASSPHRASE_VARIABLE):
        yield secret
    if sys.stdin.isatty():
        yield getpass(f"{what}: ")
