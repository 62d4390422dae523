"""``calibrator repository``: commands with which a manufacturer gives each vehicle its parameters, and no others."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from calibrator.errors import ContradictionError, RepositoryStateError
from calibrator.files.folders import require_possible_folder, write_files
from calibrator.files.storage import open_storage
from calibrator.terminal.command_line import example
from calibrator.terminal.options import JsonOption, whole_option
from calibrator.terminal.progress import shown
from calibrator.terminal.text import counted, dumps, few
from ecu_node.errors import UserError, printable
from ecu_node.program import write_output

if TYPE_CHECKING:
    from calibrator.repository.repository import NewKeys, Repository

__all__ = ["repository"]

_PASSPHRASE = "CALIBRATOR_KEY_PASSPHRASE"  # noqa: S105  # its name
_SHORTEST_PASSPHRASE = 12

repository = typer.Typer(help="Repository from which vehicles take signed parameters (TUF).", no_args_is_help=True)

FolderArgument = Annotated[Path, typer.Argument(metavar="REPOSITORY", help="Folder of the repository.")]
KeysOption = Annotated[
    list[str],
    typer.Option(
        "--key", metavar="KEY", help=f"Private key: a PEM file (passphrase: ${_PASSPHRASE}), or PUBLIC.pem=URI."
    ),
]
_PUBLIC = "Public key (PEM) of who signs {}; may be given several times."


def _tell(facts: Mapping[str, object], text: str, *, json: bool) -> None:
    write_output(dumps(facts) if json else printable(text))


def _open(folder: Path) -> "Repository":
    from calibrator.repository.repository import Repository

    return Repository(folder)


def _alone(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command, made to wait until no other command writes to the repository."""

    @wraps(command)
    def waiting(folder: Path, **options: object) -> None:
        with open_storage(folder).locked() if folder.is_dir() else nullcontext():
            command(folder, **options)

    return waiting


def _new_keys(role: str, paths: Sequence[Path], threshold: int | None) -> "NewKeys":
    from calibrator.repository.repository import NewKeys
    from ecu_node.update.signers import public_key_of

    keys = list({key.keyid: key for key in map(public_key_of, paths)}.values())
    if len(keys) < len(paths):
        raise ContradictionError(f"{role}: the same key is given twice; give each once")
    needed = threshold if threshold is not None else len(keys) // 2 + 1
    if needed > len(keys):
        raise ContradictionError(
            f"{role}: {needed} signatures of {len(keys)} keys; give more keys, or a lower threshold"
        )
    return NewKeys(keys, needed)


@repository.command("key", epilog=example("calibrator repository key anna --out keys"))
def key(
    name: Annotated[str, typer.Argument(help="Name of the signer.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for NAME.key (private) and NAME.pub.")],
    plain: Annotated[bool, typer.Option("--no-passphrase", help="Do not encrypt the private key.")] = False,
    json: JsonOption = False,
) -> None:
    """Make an Ed25519 key of one signer, as PEM files; any other PEM key of Ed25519, ECDSA or RSA serves as well."""
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    passphrase = os.environ.get(_PASSPHRASE, "")
    if bool(passphrase) == plain:
        raise ContradictionError(f"give either a passphrase for the private key (${_PASSPHRASE}) or --no-passphrase")
    if not plain and len(passphrase) < _SHORTEST_PASSPHRASE:
        raise ContradictionError(f"${_PASSPHRASE}: at least {_SHORTEST_PASSPHRASE} characters are expected")
    if not name or not name.isprintable() or "/" in name or name.startswith("."):
        raise ContradictionError(f"{name!r}: a name for a file is expected")
    pem, secret = serialization.Encoding.PEM, os.fsencode(passphrase)
    encryption = serialization.NoEncryption() if plain else serialization.BestAvailableEncryption(secret)
    made = Ed25519PrivateKey.generate()
    private, public = out / f"{name}.key", out / f"{name}.pub"
    contents = {
        public: (made.public_key().public_bytes(pem, serialization.PublicFormat.SubjectPublicKeyInfo), 0o644),
        private: (made.private_bytes(pem, serialization.PrivateFormat.PKCS8, encryption), 0o600),
    }
    path, written = out, list[Path]()
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, (content, mode) in contents.items():
            with open(path, "xb", opener=partial(os.open, mode=mode)) as file:
                written.append(path)
                file.write(content)
    except OSError as error:
        for left in written:
            left.unlink()
        why = f"cannot be written: {error.strerror}"
        if isinstance(error, FileExistsError) and path != out:
            why = "there is a key already; take another name, it cannot be made again"
        raise UserError(f"{path}: {why}") from None
    facts = {"signer": name, "private_key": str(private), "public_key": str(public)}
    _tell(facts, f"{private}  {public}", json=json)


@repository.command(
    "init",
    epilog=example(
        "calibrator repository init repo --root keys/anna.pub --root keys/ben.pub --targets keys/anna.pub "
        "--snapshot keys/online.pub --timestamp keys/online.pub"
    ),
)
def make_repository(
    folder: FolderArgument,
    root: Annotated[list[Path], typer.Option("--root", help=_PUBLIC.format("the root, offline"))],
    targets: Annotated[list[Path], typer.Option("--targets", help=_PUBLIC.format("parameters"))],
    snapshot: Annotated[list[Path], typer.Option("--snapshot", help=_PUBLIC.format("the list of all metadata"))],
    timestamp: Annotated[list[Path], typer.Option("--timestamp", help=_PUBLIC.format("how new it is"))],
    root_threshold: Annotated[
        int | None, whole_option("--root-threshold", 1, 16, "So many of them must sign (default: more than half)")
    ] = None,
    targets_threshold: Annotated[
        int | None, whole_option("--targets-threshold", 1, 16, "So many of them must sign (default: more than half)")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Begin a repository; 'publish' signs it."""
    from calibrator.repository.repository import Repository

    roles = {
        "root": _new_keys("root", root, root_threshold),
        "targets": _new_keys("targets", targets, targets_threshold),
        "snapshot": _new_keys("snapshot", snapshot, None),
        "timestamp": _new_keys("timestamp", timestamp, None),
    }
    require_possible_folder(folder)
    Repository.create(folder, roles)
    facts = {role: {"keys": len(new.keys), "threshold": new.threshold} for role, new in roles.items()}
    words = ", ".join(f"{role} {new.threshold} of {len(new.keys)}" for role, new in roles.items())
    _tell({"repository": str(folder), **facts}, f"{folder}: {words}; to be signed with 'publish'", json=json)


@repository.command("add", epilog=example("calibrator repository add repo result/params/*.json"))
@_alone
def add(
    folder: FolderArgument,
    params: Annotated[list[Path], typer.Argument(help="Parameter files, or folders of them.")],
    days: Annotated[int, whole_option("--days", 1, 3650, "How long they may be used [d]")] = 365,
    allow_large_step: Annotated[
        bool, typer.Option("--allow-large-step", help="They may differ a lot from what is in force, as after a repair.")
    ] = False,
    layout: Annotated[Path | None, typer.Option("--layout", help="Refuse files that do not fit this layout.")] = None,
    json: JsonOption = False,
) -> None:
    """Add parameter files, each for its vehicle; 'publish' signs them."""
    from ecu_node.database import node_database

    found, database = _open(folder), node_database(layout) if layout is not None else None
    files = [file for path in params for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    if not files:
        raise RepositoryStateError(f"{params[0]}: no parameter files (*.json) in it")
    reading = shown(files, "add", len(files), "files")
    bins, lifted = found.add(reading, days=days, allow_large_step=allow_large_step, database=database)
    facts = {"added": len(files), "bins": bins, "no_longer_revoked": lifted}
    words = f"; revoked before, and no longer: the files of {few(lifted)}" if lifted else ""
    changed = f"{counted(len(files), 'parameter file')} added, {counted(bins, 'bin')} changed"
    _tell(facts, f"{folder}: {changed}{words}; to be published", json=json)


@repository.command("publish", epilog=example("calibrator repository publish repo --key anna.key --key online.key"))
@_alone
def publish(folder: FolderArgument, key: KeysOption, json: JsonOption = False) -> None:
    """Sign what is staged; once all signatures are there, vehicles see it.

    The keys of snapshot and timestamp also make a new timestamp of what is published, whatever is staged: vehicles take
    no metadata that is older than 30 days.
    """
    from calibrator.repository.repository import missing_text
    from ecu_node.update.signers import signer_of

    signers, found = [signer_of(text) for text in key], _open(folder)
    found.renew()
    count = len(list((folder / "staged").glob("*.json")))
    signed = list(shown(found.sign(signers), "sign", count, "roles"))
    found.publish(signers)
    waiting = found.waiting
    if waiting:
        text = f"the timestamp is new; what is staged is not published: {missing_text(waiting)}"
    else:
        text = f"published, {counted(len(signed), 'role')} changed"
    _tell({"published": 0 if waiting else len(signed), "waiting": waiting}, f"{folder}: {text}", json=json)


@repository.command("status", epilog=example("calibrator repository status repo"))
def status(folder: FolderArgument, json: JsonOption = False) -> None:
    """Show until when vehicles take what is published, what is staged, and whose signatures are missing."""
    from calibrator.repository.repository import missing_text

    found = _open(folder)
    staged, until = list(found.sign([])), found.valid_until
    words = [f"valid until {until:%Y-%m-%d}" if until else "nothing is published yet"]
    words += [f"{counted(len(staged), 'role')} staged" + (f": {missing_text(found.missing)}" if staged else "")]
    facts = {"valid_until": until, "staged": staged, "waiting": found.missing}
    _tell(facts, f"{folder}: {'; '.join(words)}", json=json)


@repository.command("unstage", epilog=example("calibrator repository unstage repo"))
@_alone
def unstage(folder: FolderArgument, json: JsonOption = False) -> None:
    """Drop what is staged, as after a mistake; what is published stays."""
    dropped = _open(folder).unstage()
    _tell({"dropped": dropped}, f"{folder}: {counted(len(dropped), 'staged role')} dropped", json=json)


@repository.command("rotate", epilog=example("calibrator repository rotate repo timestamp --public keys/new.pub"))
@_alone
def rotate(
    folder: FolderArgument,
    role: Annotated[Literal["root", "targets", "snapshot", "timestamp"], typer.Argument(help="Whose keys.")],
    public: Annotated[list[Path], typer.Option("--public", help="All public keys that it has from now on.")],
    threshold: Annotated[
        int | None, whole_option("--threshold", 1, 16, "So many of them must sign (default: as many as before)")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Give a role other keys, as when somebody leaves or a key is stolen; 'publish' signs it."""
    found = _open(folder)
    before = found.threshold(role)
    new = _new_keys(role, public, before if threshold is None else threshold)
    found.rotate(role, new)
    facts = {"role": role, "keys": len(new.keys), "threshold": new.threshold}
    was = f" (was {before})" if new.threshold != before else ""
    _tell(facts, f"{folder}: {role} {new.threshold} of {len(new.keys)}{was}; to be published", json=json)


@repository.command("revoke", epilog=example("calibrator repository revoke repo V001"))
@_alone
def revoke(
    folder: FolderArgument,
    vehicles: Annotated[list[str], typer.Argument(help="Identities of the vehicles.")],
    sha256: Annotated[
        str | None, typer.Option("--sha256", help="Which file (default: the one that the repository has now).")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Take parameters back; 'publish' signs it, and vehicles do not use them any more once they update."""
    if sha256 is not None and (len(sha256) != 64 or set(sha256) - set("0123456789abcdef")):
        raise ContradictionError(
            f"--sha256 {sha256}: 64 digits 0-9 and a-f are expected, as 'ecu-node inspect --json' says"
        )
    if twice := sorted({name for name in vehicles if vehicles.count(name) > 1}):
        raise ContradictionError(f"{few(twice)} is named twice; name each vehicle once")
    _open(folder).revoke(vehicles, sha256)
    _tell({"revoked": vehicles}, f"{folder}: {len(vehicles)} revoked; to be published", json=json)


@repository.command("bundle", epilog=example("calibrator repository bundle repo V001 --out bundles"))
def bundle(
    folder: FolderArgument,
    vehicles: Annotated[list[str], typer.Argument(help="Identities of the vehicles.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for VEHICLE.json.xz.")],
    json: JsonOption = False,
) -> None:
    """Write all that a vehicle needs into one file, as for a USB stick; 'ecu-node update' takes it."""
    from ecu_node.update.client import target_path

    found = _open(folder)
    require_possible_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    going = shown(vehicles, "bundle", len(vehicles), "vehicles")
    bundles = {out / f"{target_path(vehicle)}.xz": found.bundle(vehicle) for vehicle in going}
    write_files(bundles)
    names, until = list(map(str, bundles)), found.valid_until
    _tell({"bundles": names, "valid_until": until}, f"{'  '.join(names)}  (valid until {until:%Y-%m-%d})", json=json)
