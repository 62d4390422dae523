"""Encrypted private keys: PKCS #8, as OpenSSL and cryptography read it, with a key derivation that takes its time.

PBES2 of RFC 8018: PBKDF2 with HMAC-SHA256 makes a key of the passphrase, AES-256-CBC encrypts. The library itself
takes 2048 rounds of PBKDF2, with which a thief of the file tries 300 times as many passphrases in the same time.
"""

import base64
import os

from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES256
from cryptography.hazmat.primitives.ciphers.modes import CBC
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.pbkdf2 import PBKDF2HMAC
from cryptography.hazmat.primitives.padding import PKCS7

__all__ = ["ROUNDS", "encrypted_pem", "is_whole_pem"]

ROUNDS = 600_000
"""Of PBKDF2, as OWASP recommends for HMAC-SHA256."""
_SALT_BYTES, _KEY_BYTES, _BLOCK_BYTES = 16, 32, 16
_LABEL = "ENCRYPTED PRIVATE KEY"
_LINE = 64
"""Characters of a line of PEM."""

_SEQUENCE, _OCTETS, _INTEGER = 0x30, 0x04, 0x02
_NULL = b"\x05\x00"
_LONG = 0x80
"""Lengths from here on have bytes of their own, and this bit beside the number of them."""
_PBES2 = bytes.fromhex("06092a864886f70d01050d")  # 1.2.840.113549.1.5.13
_PBKDF2 = bytes.fromhex("06092a864886f70d01050c")  # 1.2.840.113549.1.5.12
_HMAC_SHA256 = bytes.fromhex("06082a864886f70d0209")  # 1.2.840.113549.2.9
_AES256_CBC = bytes.fromhex("060960864801650304012a")  # 2.16.840.1.101.3.4.1.42


def encrypted_pem(key: bytes, passphrase: bytes) -> bytes:
    """Encrypt a private key.

    Parameters
    ----------
    key : bytes
        PKCS #8, DER, not encrypted.
    passphrase : bytes
        With which.

    Returns
    -------
    bytes
        EncryptedPrivateKeyInfo of RFC 5958, PEM.
    """
    salt, start = os.urandom(_SALT_BYTES), os.urandom(_BLOCK_BYTES)
    derived = PBKDF2HMAC(SHA256(), _KEY_BYTES, salt, ROUNDS).derive(passphrase)
    pad, encrypt = PKCS7(8 * _BLOCK_BYTES).padder(), Cipher(AES256(derived), CBC(start)).encryptor()
    hidden = encrypt.update(pad.update(key) + pad.finalize()) + encrypt.finalize()
    rounds = ROUNDS.to_bytes(ROUNDS.bit_length() // 8 + 1, "big")
    function = _PBKDF2 + _der(
        _SEQUENCE, _der(_OCTETS, salt) + _der(_INTEGER, rounds) + _der(_SEQUENCE, _HMAC_SHA256 + _NULL)
    )
    scheme = _AES256_CBC + _der(_OCTETS, start)
    algorithm = _PBES2 + _der(_SEQUENCE, _der(_SEQUENCE, function) + _der(_SEQUENCE, scheme))
    text = base64.b64encode(_der(_SEQUENCE, _der(_SEQUENCE, algorithm) + _der(_OCTETS, hidden))).decode()
    lines = [text[first : first + _LINE] for first in range(0, len(text), _LINE)]
    return "\n".join([f"-----BEGIN {_LABEL}-----", *lines, f"-----END {_LABEL}-----", ""]).encode()


def is_whole_pem(content: bytes) -> bool:
    """Whether a PEM file has its end, and as many bytes in it as its first ones say; what they mean is not asked."""
    body, end, _ = content.partition(b"-----BEGIN ")[2].partition(b"-----")[2].partition(b"-----END ")
    try:
        found = base64.b64decode(b"".join(body.split()), validate=True)
    except ValueError:
        return False
    if not end or len(found) < 2:
        return False
    more = found[1] & _LONG - 1 if found[1] & _LONG else 0
    size = int.from_bytes(found[2 : 2 + more], "big") if more else found[1]
    return len(found) == 2 + more + size


def _der(tag: int, content: bytes) -> bytes:
    """An element of DER."""
    size = len(content)
    if size < _LONG:
        return bytes([tag, size]) + content
    count = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes([tag, _LONG | len(count)]) + count + content
