"""Files of a signer's key: NAME.key, private (PEM, PKCS #8, mode 0600), and NAME.pub, public (canonical JSON)."""

import os
import re
import shlex
from pathlib import Path
from typing import Annotated

import msgspec
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from securesystemslib.signer import CryptoSigner, SSlibKey

from calibrator.errors import SigningError
from calibrator.signing.encryption import encrypted_pem, is_whole_pem
from ecu_node.core.status import Reason, TrustError
from ecu_node.documents import UnsuitableFileError, read_user_file, write_atomically
from ecu_node.trust.canonical import canonical_bytes, read_bytes, read_canonical
from ecu_node.trust.key_set import PublicKey

__all__ = ["PASSPHRASE_VARIABLE", "NamedKey", "new_key", "read_public_key", "read_signer"]

PASSPHRASE_VARIABLE = "CALIBRATOR_KEY_PASSPHRASE"  # noqa: S105  # its name
"""Environment variable with the passphrase of private keys."""
_LARGEST_KEY_BYTES = 100_000
_LONGEST_PASSPHRASE_BYTES = 1023
"""OpenSSL takes no longer one."""
_SHORTEST_PASSPHRASE = 8
"""Characters; of new keys."""
_OTHERS = 0o066
"""Rights of group and others to read and to write."""
_PRIVATE_KEY = re.compile(rb"-----BEGIN ([A-Z0-9 ]+ )?PRIVATE KEY-----")


class NamedKey(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Content of a public key's file."""

    keyid: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$", description="as securesystemslib names the key")]
    key: PublicKey


def new_key(name: str, folder: Path, passphrase: str | None) -> tuple[Path, Path]:
    """Make a key of a signer.

    Parameters
    ----------
    name : str
        Of the signer; names the files too.
    folder : Path
        Where; must exist.
    passphrase : str or None
        Encrypts the private key; None: it is not encrypted.

    Returns
    -------
    private, public : Path
        The two files.

    Raises
    ------
    SigningError
        If there are such files already, they cannot be written, or the passphrase is too short or too long.
    """
    private, public = folder / f"{name}.key", folder / f"{name}.pub"
    _require_good_passphrase(passphrase)
    for path in (private, public):
        if os.path.lexists(path):
            raise SigningError(f"{path}: there is a key already; take another name, it cannot be made again")
    signer = CryptoSigner.generate_ed25519()
    key = load_pem_private_key(signer.private_bytes, None)
    if passphrase is None:
        text = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    else:
        text = encrypted_pem(
            key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption()), os.fsencode(passphrase)
        )
    try:
        handle = os.open(private, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise _not_written(folder, error) from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(handle)
        write_atomically(public, canonical_bytes(_named(name, signer.public_key)) + b"\n")
    except BaseException as error:
        private.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _not_written(folder, error) from None
        raise
    return private, public


def _require_good_passphrase(passphrase: str | None) -> None:
    if passphrase is None:
        return
    if len(passphrase) < _SHORTEST_PASSPHRASE:
        raise SigningError(
            f"${PASSPHRASE_VARIABLE}: shorter than {_SHORTEST_PASSPHRASE} characters, which a thief of the key would "
            f"soon find; take a longer one"
        )
    if len(os.fsencode(passphrase)) > _LONGEST_PASSPHRASE_BYTES:
        raise SigningError(
            f"${PASSPHRASE_VARIABLE}: longer than {_LONGEST_PASSPHRASE_BYTES} bytes, which no key can be encrypted "
            f"with; take a shorter one"
        )


def _not_written(folder: Path, error: OSError) -> SigningError:
    return SigningError(f"{folder}: no key can be written there: {error.strerror}")


def _named(name: str, key: SSlibKey) -> NamedKey:
    return NamedKey(keyid=key.keyid, key=PublicKey(name=name, ed25519=key.keyval["public"]))


def read_public_key(path: Path) -> NamedKey:
    """Read a public key's file.

    Parameters
    ----------
    path : Path
        From :func:`new_key`.

    Returns
    -------
    NamedKey
        Key and name of the signer.

    Raises
    ------
    SigningError
        If it is none.
    """
    try:
        return read_canonical(read_bytes(path).removesuffix(b"\n"), NamedKey, str(path))
    except TrustError as error:
        if error.reason is Reason.NO_PARAMETERS:  # there is no such file, or it may not be read
            raise SigningError(str(error)) from None
        raise SigningError(f"{path}: not a public key; one from 'calibrator keys new' is expected") from None


def read_signer(path: Path, passphrase: str | None) -> CryptoSigner:
    """Read a private key.

    Parameters
    ----------
    path : Path
        PEM, PKCS #8, Ed25519.
    passphrase : str or None
        With which it is encrypted.

    Returns
    -------
    CryptoSigner
        Signs in the name of the key's owner.

    Raises
    ------
    SigningError
        If it is none, others may read or write it, or the passphrase is another one.
    """
    content = _private_bytes(path)
    try:
        key = load_pem_private_key(content, os.fsencode(passphrase) if passphrase is not None else None)
    except TypeError:
        need = "it is encrypted" if passphrase is None else "it is not encrypted, and yet a passphrase is given"
        raise SigningError(f"{path}: {need}; see ${PASSPHRASE_VARIABLE}") from None
    except (ValueError, UnsupportedAlgorithm):
        if b"ENCRYPTED" in content and is_whole_pem(content):
            why = f"is encrypted with another passphrase than that in ${PASSPHRASE_VARIABLE}"
        else:
            why = "cannot be read: the file is damaged, or not PKCS #8; take a copy of it"
        raise SigningError(f"{path}: a private key, but {why}") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise SigningError(f"{path}: a private key, but not of kind Ed25519; make one with 'calibrator keys new'")
    return CryptoSigner(key)


def _private_bytes(path: Path) -> bytes:
    """Content of a file that is a private key, and its owner's alone."""
    try:
        content = read_user_file(path, largest_bytes=_LARGEST_KEY_BYTES)
        rights = path.stat().st_mode
    except UnsuitableFileError as error:
        raise SigningError(f"{path}: not a private key: {error}") from None
    except OSError as error:
        raise SigningError(
            f"{path}: cannot read the private key: {error.strerror}; give NAME.key of a signer"
        ) from None
    if _PRIVATE_KEY.search(content) is None:
        raise SigningError(f"{path}: not a private key (PEM); NAME.key of 'calibrator keys new' is expected")
    if rights & _OTHERS:
        raise SigningError(
            f"{path}: others than its owner can read or write this private key (mode {rights & 0o777:03o}); "
            f"'chmod 600 {shlex.quote(str(path))}', and if somebody may have read it, make another key"
        )
    return content
