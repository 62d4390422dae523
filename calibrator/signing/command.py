"""``calibrator keys``, ``sign`` and ``revoke``: what a manufacturer's signers do, each on a machine of their own."""

import os
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from calibrator.errors import ContradictionError, SigningError
from calibrator.files.folders import (
    made_folder,
    remove_abandoned,
    require_own_file,
    require_possible_folder,
    write_files,
)
from calibrator.signing.key_files import PASSPHRASE_VARIABLE, new_key, read_public_key, read_signer
from calibrator.signing.numbers import require_near_number, signing_time, time_text
from calibrator.signing.orders import Order
from calibrator.signing.statements import signed_statement
from calibrator.terminal.command_line import example
from calibrator.terminal.options import JsonOption, whole_option
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps
from ecu_node.errors import printable
from ecu_node.program import say_error, write_output
from ecu_node.trust.canonical import Expected, canonical_bytes, read_canonical
from ecu_node.trust.key_set import SIGNER_NAME, KeySet, check_key_set
from ecu_node.trust.statements import LAST_SEQUENCE, MAX_SEQUENCE, Revocation

__all__ = ["keys", "revoke", "sign"]

_LONGEST_DAYS = 3650
MOST_SIGNERS = 16
_HIGHEST_VERSION = 1_000_000
"""Of a key set."""
_REVOCATION = Expected(what="a revocation that a vehicle would take", advice="change the options")

_KEY_SET = Expected(what="a key set that a vehicle would take", advice="change the options")

keys = typer.Typer(help="Keys of signers, and the set of them that vehicles trust.", no_args_is_help=True)

KeyOption = Annotated[
    list[Path],
    typer.Option("--key", metavar="PATH", help=f"Private key of a signer. Its passphrase: ${PASSPHRASE_VARIABLE}."),
]
OutFileOption = Annotated[Path, typer.Option("--out", help="File to write.")]
_SEQUENCE = "Number, above all that the vehicle accepted (default: time in seconds, UTC)"
FarOption = Annotated[
    bool,
    typer.Option(
        "--far-sequence", help="The number may be far above the time, as where the vehicle took such a one by mistake."
    ),
]
RevokedOption = Annotated[list[int], whole_option("--number", 1, LAST_SEQUENCE, "Number that was signed")]


@keys.command("new", epilog=example("calibrator keys new alice --out keys"))
def new(
    name: Annotated[str, typer.Argument(help="Name of the signer.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for NAME.key (private) and NAME.pub.")],
    plain: Annotated[bool, typer.Option("--no-passphrase", help="Do not encrypt the private key.")] = False,
    json: JsonOption = False,
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
    with made_folder(out):
        made = new_key(name, out, passphrase)
    private, public = made
    _tell({"signer": name, "private_key": str(private), "public_key": str(public)}, made, json=json)


@keys.command("set", epilog=example("calibrator keys set keys/alice.pub keys/bob.pub --threshold 2 --out keys/set"))
def make_set(
    public: Annotated[list[Path], typer.Argument(help="Public keys (NAME.pub) of all signers.")],
    threshold: Annotated[int, whole_option("--threshold", 1, MOST_SIGNERS, "So many of them must sign")],
    out: OutFileOption,
    version: Annotated[int, whole_option("--version", 1, _HIGHEST_VERSION, "One more than that of the set before")] = 1,
    key: KeyOption = [],  # noqa: B006
    json: JsonOption = False,
) -> None:
    """Say whom vehicles trust. The first set is not signed; a later one by enough of the set before and of its own."""
    named = [read_public_key(path) for path in public]
    found = KeySet(version=version, threshold=threshold, keys={item.keyid: item.key for item in named})
    if len(found.keys) < len(named):
        raise SigningError("one key is given twice; each signer has one of their own, give each once")
    check_key_set(found, "key set")
    if bool(key) != (version > 1):
        raise ContradictionError(
            "the first key set is not signed, and every later one is: give --key from version 2 on"
        )
    signers = [read_signer(path, _passphrase()) for path in key]
    plain = canonical_bytes(found)
    read_canonical(plain, KeySet, "key set", _KEY_SET)
    _write_one(out, signed_statement(found, signers) if signers else plain + b"\n")
    facts = {"version": version, "threshold": threshold, "signers": sorted(item.key.name for item in named)}
    _tell({"file": str(out), **facts}, [out], json=json)


def sign(
    params: Annotated[list[Path], typer.Argument(help="Parameter files, or signed files to be signed by one more.")],
    key: KeyOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the signed files.")],
    sequence: Annotated[int | None, whole_option("--sequence", 1, MAX_SEQUENCE, _SEQUENCE)] = None,
    days: Annotated[
        int | None, whole_option("--days", 1, _LONGEST_DAYS, "How long they hold, from now on [d] (default: 365)")
    ] = None,
    allow_large_step: Annotated[
        bool, typer.Option("--allow-large-step", help="They may differ a lot from what is in force, as after a repair.")
    ] = False,
    far_sequence: FarOption = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that exist.")] = False,
    json: JsonOption = False,
) -> None:
    """Sign parameter files, one signed file per vehicle; 'ecu-node activate' takes them.

    The same command, run again within a day, keeps what it signed, and goes on.
    """
    now = signing_time(datetime.now(UTC))
    require_near_number(sequence, now, far=far_sequence)
    order = Order(
        signers=[read_signer(path, _passphrase()) for path in key],
        now=now,
        sequence=sequence,
        days=days,
        allow_large_step=allow_large_step,
    )
    require_possible_folder(out)
    places = {out / path.name: path for path in params}
    if len(places) < len(params):
        raise SigningError(f"files of one name would overwrite each other in {out}; sign them one after the other")
    files: dict[Path, bytes | None] = {}
    for place, path in shown(places.items(), "sign", len(places), "files"):
        files[place] = None if not replace and order.is_done(path, place) else order.signed(path)
    done = {place for place, content in files.items() if content is None}
    for place in places.keys() - done:
        require_own_file(place)
    there = sorted(place for place in places.keys() - done if place.exists())
    if there and not replace:
        raise SigningError(
            f"{there[0]}: there is a file already, and not what this command wrote within a day; name another folder, "
            f"or replace it with --replace"
        )
    _write_all(files, out)
    if done and not json:
        say_error(f"notice: {len(done)} of {len(files)} were signed before by the same command, and are kept")
    signed = [str(place) for place in files if place not in done]
    _tell({"signed": signed, "kept": sorted(map(str, done))}, list(files), json=json)


def revoke(
    vehicle: Annotated[str, typer.Option(help="Identity of the vehicle.")],
    number: RevokedOption,
    why: Annotated[str, typer.Option(help="Reason, for the vehicle's audit log.")],
    key: KeyOption,
    out: OutFileOption,
    sequence: Annotated[int | None, whole_option("--sequence", 1, LAST_SEQUENCE, _SEQUENCE)] = None,
    far_sequence: FarOption = False,
    json: JsonOption = False,
) -> None:
    """Take signed parameters of a vehicle back; 'ecu-node revoke' takes the file."""
    now = signing_time(datetime.now(UTC))
    require_near_number(sequence, now, far=far_sequence)
    statement = Revocation(
        vehicle=vehicle,
        sequence=sequence or int(now.timestamp()),
        created=time_text(now),
        revokes=sorted(set(number)),
        why=why,
    )
    read_canonical(canonical_bytes(statement), Revocation, "revocation", _REVOCATION)
    _write_one(out, signed_statement(statement, [read_signer(path, _passphrase()) for path in key]))
    facts = {"vehicle": vehicle, "sequence": statement.sequence, "revokes": statement.revokes}
    _tell({"file": str(out), **facts}, [out], json=json)


def _write_one(path: Path, content: bytes) -> None:
    require_own_file(path)
    if path.exists():
        raise SigningError(f"{path}: there is a file already; name another one")
    remove_abandoned([path])
    write_files({path: content})


def _write_all(files: Mapping[Path, bytes | None], out: Path) -> None:
    """Write files one by one, so that none of them waits for the others; None: it is there already."""
    with made_folder(out):
        remove_abandoned(files)
        for path, content in files.items():
            if content is not None:
                write_files({path: content})


def _tell(facts: Mapping[str, object], paths: Sequence[Path], *, json: bool) -> None:
    """Print what was made: the files, a line each, or all of it as JSON."""
    write_output(dumps(facts) if json else "\n".join(printable(str(path)) for path in paths))


def _passphrase() -> str | None:
    return os.environ.get(PASSPHRASE_VARIABLE) or None
