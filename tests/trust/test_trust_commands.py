"""Every refusal through the command line: one line, exit code 1, no traceback, and a state that is as before."""

import base64
import codecs
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from random import Random

import pytest
import rfc8785
from msgspec.structs import replace

from ecu_node.parameters import VehicleParameters
from ecu_node.trust.audit import broken_line
from ecu_node.trust.canonical import MAX_BYTES
from ecu_node.trust.state import audit_path, read_state
from tests.trust.signing import Run, Signers, on

HOUR, DAY = timedelta(hours=1), timedelta(days=1)


def contents(state: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in state.iterdir() if path.name not in {"audit.log", "lock"}}


def require_refused(run: Run, state: Path, path: Path, words: str) -> None:
    before = contents(state)
    for command in ("verify", "activate"):
        code, out, err = run(command, path, *on(state))
        assert (code, out) == (1, ""), words
        assert err.startswith((f"ecu-node: {path}: ", f"ecu-node: {path}, signed content: ")), err
        assert err.endswith("\n")
        assert err[:-1].isprintable(), f"one line is expected: {err!r}"
        assert words in err
        assert contents(state) == before
    assert broken_line(audit_path(state)) is None


def refused_files(signers: Signers, parameters: VehicleParameters, now: datetime) -> dict[str, tuple[bytes, str]]:
    """What is signed, and must be refused all the same, with words of the line."""
    other = "0" * 64
    battery = parameters.branches["battery"]

    def signed(parameters: VehicleParameters, number: int = 6, **more: object) -> bytes:
        return signers.parameters(parameters, number, **({"not_before": now - HOUR} | more))  # type: ignore[arg-type]

    def with_battery(**faults: float) -> VehicleParameters:
        return replace(parameters, branches={"battery": replace(battery, **faults)})

    dbc = replace(parameters, dbc=replace(parameters.dbc, sha256=other))
    layout = replace(parameters, layout=replace(parameters.layout, sha256=other))
    return {
        "stranger": (signed(parameters, by="ad"), "which is not trusted here"),
        "one signer": (signed(parameters, by="a"), "signed by a; 2 signers are needed"),
        "expired": (signed(parameters, expires=now - HOUR), "expired at"),
        "early": (signed(parameters, not_before=now + DAY), "is the clock set?"),
        "older": (signed(parameters, 4), "number 4, and 5 was accepted before"),
        "same": (signed(parameters, 5), "number 5, and 5 was accepted before"),
        "vehicle": (signed(replace(parameters, vehicle="v2")), "for vehicle 'v2', this is 'v1'"),
        "DBC": (signed(dbc), "made with DBC"),
        "layout": (signed(layout), "made with layout"),
        "drift": (signed(with_battery(drift=0.9), allow_large_step=True), "beyond the layout's limit"),
        "offset": (signed(with_battery(offset_a=999.0), allow_large_step=True), "beyond the layout's limit"),
        "step": (signed(with_battery(drift=0.3)), "sign with --allow-large-step"),
    }


def test_what_is_signed_and_does_not_fit_is_refused(
    in_force: Path, signers: Signers, parameters: VehicleParameters, now: datetime, tmp_path: Path, run: Run
) -> None:
    for name, (content, words) in refused_files(signers, parameters, now).items():
        path = tmp_path / f"{name}.json"
        path.write_bytes(content)
        require_refused(run, in_force, path, words)


def resigned(signers: Signers, file: bytes, old: bytes, new: bytes) -> bytes:
    """The file with other bytes in its statement, under right signatures."""
    from calibrator.signing.statements import signed_anew  # noqa: PLC0415
    from ecu_node.trust.envelope import Envelope  # noqa: PLC0415

    envelope = json.loads(file)
    payload = base64.b64decode(envelope["payload"])
    assert payload.count(old) == 1
    changed = base64.b64encode(payload.replace(old, new)).decode()
    return signed_anew(Envelope(payload=changed, payloadType=envelope["payloadType"], signatures=[]), signers.of("ab"))


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("empty", lambda file: b"", "not a signed file: it is empty"),
        ("half", lambda file: file[: len(file) // 2], "its end is missing"),
        ("half with an end", lambda file: file[: len(file) // 2] + b"\n", "not a signed file"),
        ("nested", lambda file: b"[" * 100_000 + b"]" * 100_000 + b"\n", "it is nested too deeply"),
        ("nested field", lambda file: b'{"payload":' * 9000 + b"1" + b"}" * 9000 + b"\n", "not a signed file"),
        ("twice", lambda file: file.replace(b'"payload":', b'"payload":"","payload":', 1), "not canonical JSON"),
        ("NaN", lambda file: file.replace(b'"signatures":', b'"a":NaN,"signatures":'), "not a signed file"),
        ("Infinity", lambda file: file.replace(b'"signatures":', b'"a":Infinity,"signatures":'), "not a signed file"),
        ("not UTF-8", lambda file: file.replace(b'"payloadType":"a', b'"payloadType":"\xff'), "not a signed file"),
        ("UTF-16", lambda file: file.decode().encode("utf-16"), "not a signed file"),
        ("zeros", lambda file: bytes(5000), "not a signed file: JSON is malformed"),
        ("noise", lambda file: Random(1).randbytes(3000), "not a signed file: JSON is malformed"),
        ("BOM", lambda file: codecs.BOM_UTF8 + file, "not a signed file: it begins with a byte order mark (BOM)"),
        ("line in a name", lambda file: b'{"a\\nb\\u001b[2J":1}\n', "unknown field `a\\nb\\x1b[2J`"),
        ("long name", lambda file: b'{"' + b"a" * 100_000 + b'":1}\n', "unknown field `aaaa"),
        ("line in a key", lambda file: _keyid(file, "\nb"), "signed with key \\nb, which is not trusted here"),
        ("other signature", lambda file: _keyid(file, ""), "not a signed file"),
    ],
)
def test_what_is_no_signed_file_is_refused(
    name: str,
    make: Callable[[bytes], bytes],
    words: str,
    in_force: Path,
    signers: Signers,
    parameters: VehicleParameters,
    now: datetime,
    tmp_path: Path,
    run: Run,
) -> None:
    path = tmp_path / f"{name}.json"
    path.write_bytes(make(signers.parameters(parameters, 6, not_before=now - HOUR)))
    require_refused(run, in_force, path, words)
    assert len(audit_path(in_force).read_bytes().splitlines()[-1]) < 2000


def _keyid(file: bytes, keyid: str) -> bytes:
    envelope = json.loads(file)
    envelope["signatures"][0]["keyid"] = keyid
    return bytes(rfc8785.dumps(envelope)) + b"\n"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"sequence":6', b'"sequence":6,"sequence":6'),
        (b'"drift":0.05', b'"drift":NaN'),
        (b'"drift":0.05', b'"drift":Infinity'),
        (b'"drift":0.05', b'"drift":5e-2'),
        (b'"drift":0.05', b'"drift":' + b"[" * 5000 + b"]" * 5000),
        (b'"vehicle":"v1"', b'"vehicle":"v\xff"'),
        (b'"sequence":6', b'"sequence":99999999999999999999'),
        (b'"sequence":6', b'"sequence": 6'),
    ],
)
def test_statements_in_other_words_are_refused_under_right_signatures(
    old: bytes,
    new: bytes,
    in_force: Path,
    signers: Signers,
    parameters: VehicleParameters,
    now: datetime,
    tmp_path: Path,
    run: Run,
) -> None:
    path = tmp_path / "f.json"
    path.write_bytes(resigned(signers, signers.parameters(parameters, 6, not_before=now - HOUR), old, new))
    require_refused(run, in_force, path, "signed content: not a signed file")


def test_every_byte_of_a_file_counts(
    in_force: Path, signers: Signers, parameters: VehicleParameters, now: datetime, tmp_path: Path, run: Run
) -> None:
    """In the file on the disk, through the command; all the bytes are flipped without it elsewhere."""
    content = signers.parameters(parameters, 6, not_before=now - HOUR)
    path = tmp_path / "f.json"
    for place in range(0, len(content), 41):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        code, _, err = run("verify", path, *on(in_force))
        assert (code, len(err.splitlines())) == (1, 1), place
    path.write_bytes(content)
    assert run("verify", path, *on(in_force))[0] == 0


def command(*arguments: object, memory_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """The command line as a process of its own."""

    def limit() -> None:
        if memory_bytes is not None:
            resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))

    return subprocess.run(
        [sys.executable, "-m", "ecu_node", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=limit,
    )


@pytest.mark.parametrize("name", ["activate", "verify", "revoke"])
def test_a_file_of_a_gibibyte_is_refused_at_once_and_without_memory(name: str, in_force: Path, tmp_path: Path) -> None:
    path = tmp_path / "huge.json"
    path.touch()
    os.truncate(path, 1 << 30)  # sparse: no disk is filled
    start_s = time.monotonic()
    done = command(name, path, *on(in_force), memory_bytes=1 << 28)
    assert time.monotonic() - start_s < 20.0
    words = f"it is larger than {MAX_BYTES} bytes, which no such file is; sign the parameters anew\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"ecu-node: {path}: not a signed file: {words}")


def test_what_is_no_file_is_refused(in_force: Path, tmp_path: Path, run: Run) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    for path, words in (
        (tmp_path / "pipe", "it is a pipe; a file is expected"),
        (tmp_path / "device", "it is a device; a file is expected"),
        (tmp_path, "it is a folder; a file is expected"),
        (tmp_path / "none", "cannot read the file: No such file or directory"),
        (tmp_path / ("x" * 300), "cannot read the file: File name too long"),
    ):
        require_refused(run, in_force, path, words)


def test_a_name_that_is_no_text_is_told_and_kept_in_the_log(in_force: Path, tmp_path: Path) -> None:
    path = tmp_path / "f\udcff.json"
    path.write_bytes(b"{}\n")
    done = command("activate", path, *on(in_force))
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert "missing required field" in done.stderr
    assert b"udcff.json: not a signed file" in audit_path(in_force).read_bytes()
    assert broken_line(audit_path(in_force)) is None


def test_a_command_takes_only_its_own_kind_of_statement(
    in_force: Path, signers: Signers, parameters: VehicleParameters, now: datetime, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "p").write_bytes(signers.parameters(parameters, 6, not_before=now - HOUR))
    (tmp_path / "r").write_bytes(signers.revocation(6, 5))
    assert "use 'ecu-node activate'" in run("revoke", tmp_path / "p", *on(in_force))[2]
    assert "use 'ecu-node revoke'" in run("activate", tmp_path / "r", *on(in_force))[2]
    assert read_state(in_force).highest_sequence == 5
    said = "revoked: number 6, 5: wrong drives; nothing is in force now; signed by a, b\n"
    assert run("revoke", tmp_path / "r", *on(in_force)) == (0, said, "")
