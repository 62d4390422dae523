"""``calibrator keys``, ``sign`` and ``revoke``: what a manufacturer's signers do, each on a machine of their own."""

import os
import re
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer
from securesystemslib.signer import CryptoSigner

from calibrator.errors import ContradictionError, SigningError
from calibrator.folders import require_possible_folder
from calibrator.signing.key_files import PASSPHRASE_VARIABLE, new_key, read_public_key, read_signer
from calibrator.signing.statements import signed_anew, signed_statement
from ecu_node.errors import TrustError, printable
from ecu_node.parameters import read_parameters, write_atomically
from ecu_node.trust.canonical import Expected, canonical_bytes, read_bytes, read_canonical
from ecu_node.trust.envelope import Envelope
from ecu_node.trust.key_set import SIGNER_NAME, KeySet, check_key_set
from ecu_node.trust.statements import Revocation, SignedParameters, open_statement

__all__ = ["keys", "revoke", "sign"]

_TIME = "%Y-%m-%dT%H:%M:%SZ"
_DAYS, _LONGEST_DAYS = 365, 3650
_REVOCATION = Expected(what="a revocation that a vehicle would take", advice="change the options")

_KEY_SET = Expected(what="a key set that a vehicle would take", advice="change the options")

keys = typer.Typer(help="Keys of signers, and the set of them that vehicles trust.", no_args_is_help=True)

KeyOption = Annotated[
    list[Path],
    typer.Option("--key", help=f"Private key of a signer; repeat for several. Its passphrase: ${PASSPHRASE_VARIABLE}."),
]
OutFileOption = Annotated[Path, typer.Option("--out", help="File to write.")]
SequenceOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=(1 << 53) - 1,
        help="Number, above all that the vehicle accepted (default: time in seconds, UTC).",
    ),
]
RevokedOption = Annotated[
    list[int], typer.Option("--number", min=1, help="Number that was signed; repeat for several.")
]


@keys.command("new")
def new(
    name: Annotated[str, typer.Argument(help="Name of the signer.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for NAME.key (private) and NAME.pub.")],
    plain: Annotated[bool, typer.Option("--no-passphrase", help="Do not encrypt the private key.")] = False,
) -> None:
    """Make the key of one signer."""
    passphrase = _passphrase()
    if (passphrase is None) != plain:
        raise ContradictionError(
            f"give either a passphrase for the private key (${PASSPHRASE_VARIABLE}) or --no-passphrase"
        )
    if not re.match(SIGNER_NAME, name):
        raise SigningError(f"{name!r}: a name of letters, digits, '.', '_' and '-' is expected")
    require_possible_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    sys.stdout.write("".join(f"{printable(str(path))}\n" for path in new_key(name, out, passphrase)))


@keys.command("set")
def make_set(
    public: Annotated[list[Path], typer.Argument(help="Public keys (NAME.pub) of all signers.")],
    threshold: Annotated[int, typer.Option(min=1, max=16, help="So many of them must sign.")],
    out: OutFileOption,
    version: Annotated[int, typer.Option(min=1, help="One more than that of the set before.")] = 1,
    key: KeyOption = [],  # noqa: B006
) -> None:
    """Say whom vehicles trust. The first set is not signed; a later one by enough of the set before and of its own."""
    named = [read_public_key(path) for path in public]
    found = KeySet(version=version, threshold=threshold, keys={item.keyid: item.key for item in named})
    if len(found.keys) < len(named):
        raise SigningError("one key is given twice; each signer has one of their own")
    check_key_set(found, "key set")
    if bool(key) != (version > 1):
        raise ContradictionError(
            "the first key set is not signed, and every later one is: give --key from version 2 on"
        )
    signers = [read_signer(path, _passphrase()) for path in key]
    plain = canonical_bytes(found)
    read_canonical(plain, KeySet, "key set", _KEY_SET)
    content = signed_statement(found, signers) if signers else plain + b"\n"
    _write({out: content}, replace=False)


def sign(
    params: Annotated[list[Path], typer.Argument(help="Parameter files, or signed files to be signed by one more.")],
    key: KeyOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the signed files.")],
    sequence: SequenceOption = None,
    days: Annotated[
        int | None, typer.Option(min=1, max=_LONGEST_DAYS, help="How long they hold, from now on. [d] (default: 365)")
    ] = None,
    allow_large_step: Annotated[
        bool, typer.Option("--allow-large-step", help="They may differ a lot from what is in force, as after a repair.")
    ] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that exist.")] = False,
) -> None:
    """Sign parameter files, one signed file per vehicle; 'ecu-node activate' takes them."""
    signers = [read_signer(path, _passphrase()) for path in key]
    require_possible_folder(out)
    now = datetime.now(UTC)
    files = {}
    for path in params:
        content = _signed_before(path)
        if content is not None and (sequence is not None or days is not None or allow_large_step):
            raise ContradictionError(
                f"{path}: it is signed already, and can only be signed by one more; leave --sequence, --days and "
                f"--allow-large-step out, or sign the parameter file"
            )
        if content is None:
            statement = SignedParameters(
                sequence=sequence or int(now.timestamp()),
                not_before=now.strftime(_TIME),
                expires=(now + timedelta(days=days or _DAYS)).strftime(_TIME),
                allow_large_step=allow_large_step,
                parameters=read_parameters(path),
            )
            files[out / path.name] = _signed(path, statement, signers)
        else:
            files[out / path.name] = _signed(path, open_statement(content, str(path))[0], signers)
    if len(files) < len(params):
        raise SigningError(f"files of one name would overwrite each other in {out}; sign them one after the other")
    out.mkdir(parents=True, exist_ok=True)
    _write(files, replace=replace)


def revoke(
    vehicle: Annotated[str, typer.Option(help="Identity of the vehicle.")],
    number: RevokedOption,
    why: Annotated[str, typer.Option(help="Reason, for the vehicle's audit log.")],
    key: KeyOption,
    out: OutFileOption,
    sequence: SequenceOption = None,
) -> None:
    """Take signed parameters of a vehicle back; 'ecu-node revoke' takes the file."""
    now = datetime.now(UTC)
    statement = Revocation(
        vehicle=vehicle,
        sequence=sequence or int(now.timestamp()),
        created=now.strftime(_TIME),
        revokes=sorted(set(number)),
        why=why,
    )
    read_canonical(canonical_bytes(statement), Revocation, "revocation", _REVOCATION)
    _write({out: signed_statement(statement, [read_signer(path, _passphrase()) for path in key])}, replace=False)


def _signed(path: Path, what: SignedParameters | Envelope, signers: list[CryptoSigner]) -> bytes:
    """A signed file that can be read again."""
    try:
        content = signed_anew(what, signers) if isinstance(what, Envelope) else signed_statement(what, signers)
        open_statement(content, "signed")
    except TrustError as error:
        raise SigningError(f"{path}: no vehicle could read this signed: {error}") from None
    return content


def _signed_before(path: Path) -> bytes | None:
    """Content of a file that is signed already; None if it is a parameter file, or nothing of either kind."""
    try:
        content = read_bytes(path)
        open_statement(content, str(path))
    except TrustError:
        return None
    return content


def _write(files: dict[Path, bytes], *, replace: bool) -> None:
    there = [path for path in files if path.exists()]
    if there and not replace:
        raise SigningError(f"{there[0]}: there is a file already; name another one")
    for path, content in files.items():
        try:
            write_atomically(path, content)
        except OSError as error:
            raise SigningError(f"{path}: cannot be written: {error.strerror}") from None
        print(printable(str(path)))


def _passphrase() -> str | None:
    return os.environ.get(PASSPHRASE_VARIABLE) or None
