"""The C core: how large and how fast it is, and whether any bytes do it harm.

python -m bench.c_core measure            bytes and instructions per frame (gcc, binutils, valgrind)
python -m bench.c_core fuzz --seconds S   libFuzzer with the sanitizers of memory and undefined behaviour (clang)

tests/calibrator/export/test_c_core.py compares it with the node.
"""

import re
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from itertools import islice, product
from pathlib import Path
from random import Random
from struct import Struct
from typing import Literal

import typer

import ecu_node
from bench.row import LAYOUT, Row, show
from bench.true_parameters import true_parameters
from calibrator.export.core import Checked, c_text
from ecu_node.bus.wiring import received
from ecu_node.core.e2e import protection_of
from ecu_node.core.signals import BitPlace, bit_place
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters

CORE = Path(ecu_node.__file__).parent / "c"
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")
RECORD = Struct("<IBB64s")
"""A frame: identifier (bit 31 set: 29 bits), length, result (0 unchanged, 1 changed, 2 not passed on), payload."""

_HERE = Path(__file__).parent
SILENCE = 255
"""Length that stands for a silence of all messages so long that each begins anew."""


def vehicle(layout: Path = _HERE / "c_core_vehicle.toml") -> Checked:
    """Make a vehicle with faults in all sensors but that of branch "passed"; the default layout uses the core fully."""
    database, rng = read_database(read_layout(layout)), Random(1)
    limit, offset_a = database.layout.limits.drift, 0.1 * database.layout.full_scale_a
    faults = {
        name: BranchParameters(
            drift=round(rng.uniform(-limit, limit), 4), offset_a=round(rng.uniform(-1, 1) * offset_a, 3), apply=True
        )
        for name in database.layout.branch_names
        if name != "passed"
    }
    return Checked(name="bench", digest="0" * 64, parameters=true_parameters(database, faults), database=database)


def frames(database: VehicleDatabase, rng: Random, count: int) -> Iterator[tuple[int, bytes | None]]:
    """Yield identifier and payload of random frames, most of them valid.

    In some a counter jumps, a bit is changed, or the payload is cut; a payload of None is a silence. Bit 31 of the
    identifier is set if it has 29 bits.
    """
    messages = []
    for key, message in received(database).items():
        protection = protection_of(database, message)
        places = [bit_place(item) for item in message.signals]
        messages.append((key.identifier | key.extended << 31, message.length, protection, places))
    counters = [0] * len(messages)
    for _ in range(count):
        kind, number = rng.random(), int(rng.random() * len(messages))
        identifier, length, protection, places = messages[number]
        payload = bytearray(rng.randbytes(length if kind < 0.98 else int(rng.random() * 65)))
        if kind < 1e-4:
            yield identifier, None
            continue
        if len(payload) >= length:
            for place in places:
                if rng.random() < 0.2:
                    _put_edge(place, payload, rng)
            if protection is not None:
                step = 1 if kind < 0.8 else int(rng.random() * 8)
                counters[number] = (counters[number] + step) % protection.modulus
                protection.counter.put(payload, counters[number])
                protection.seal(payload)
        if 0.9 < kind < 0.93 and payload:
            payload[int(rng.random() * len(payload))] ^= 1 << int(rng.random() * 8)
        yield identifier, bytes(payload)


def _put_edge(place: BitPlace, payload: bytearray, rng: Random) -> None:
    """Put a code near either end of the signal's width, or near 0, into a payload."""
    edge = (place.lowest, place.highest, 0)[int(rng.random() * 3)] + int(rng.random() * 9) - 4
    place.put(payload, min(max(edge, place.lowest), place.highest))


def record(identifier: int, payload: bytes | None) -> bytes:
    """Return the bytes of :data:`RECORD` for a frame, or for a silence (None)."""
    return RECORD.pack(identifier, SILENCE if payload is None else len(payload), 0, payload or b"")


def build(checked: Checked, folder: Path, *, compiler: str = "gcc", flags: tuple[str, ...] = ("-O2",)) -> Path:
    """Compile core, exported data and driver with all warnings as errors, and return the path of the program."""
    (folder / "hv_calibration.c").write_text(c_text(checked))
    driver, objects = _HERE / "c_core_driver.c", []
    for source in (CORE / "hv_correction.c", folder / "hv_calibration.c", driver):
        objects.append(folder / f"{source.stem}.o")
        strict = () if source == driver else FLAGS
        subprocess.run([compiler, *strict, *flags, "-g", f"-I{CORE}", "-c", source, "-o", objects[-1]], check=True)
    subprocess.run([compiler, *flags, "-no-pie", *objects, "-o", folder / "driver"], check=True)
    return folder / "driver"


def run(program: Path, given: bytes, *words: str) -> bytes:
    """Run the driver on these records, or with these arguments, and return what it writes."""
    return subprocess.run([program, *words], input=given, stdout=subprocess.PIPE, check=True).stdout


def measure(folder: Path, count: int = 10_000, flags: Sequence[str] = ("-Os", "-O2")) -> Iterator[Row]:
    """Measure bytes of code, and instructions per frame of the project's battery message, with and without E2E."""
    (folder / "bare.toml").write_text(LAYOUT.read_text().split("[e2e]")[0])
    (folder / "hv_powertrain.dbc").write_bytes(LAYOUT.with_suffix(".dbc").read_bytes())
    for flag, (path, what) in product(flags, ((LAYOUT, "with E2E P01"), (folder / "bare.toml", "without E2E"))):
        checked = vehicle(path)
        program, out = build(checked, folder, flags=(flag,)), folder / "callgrind.out"
        for part in ("hv_correction", "hv_calibration") if path == LAYOUT else ():
            size = subprocess.run(["size", folder / f"{part}.o"], capture_output=True, text=True, check=True).stdout
            total = sum(map(int, size.splitlines()[1].split()[:3]))
            yield Row(name=f"C core, gcc {flag}, {part}.o", value=total, unit="byte")
        battery = checked.database.message("HV_Battery").frame_id
        given = (record(*frame) for frame in frames(checked.database, Random(4), 40 * count) if frame[0] == battery)
        options = ("--collect-atstart=no", "--toggle-collect=hv_forward", "--quiet", f"--callgrind-out-file={out}")
        command: list[str | Path] = ["valgrind", "--tool=callgrind", *options, program]
        subprocess.run(command, input=b"".join(islice(given, count)), capture_output=True, check=True)
        (instructions, *_) = re.findall(r"^(?:summary|totals): (\d+)", out.read_text(), flags=re.MULTILINE)
        yield Row(name=f"C core, gcc {flag}, frame {what}", value=int(instructions) / count, unit="instructions")


def fuzz(folder: Path, seconds: int) -> None:
    """Fuzz the core with any calibration and any frames, until the time is over or something goes wrong."""
    (folder / "hv_calibration.c").write_text(c_text(vehicle()))
    sources = [CORE / "hv_correction.c", folder / "hv_calibration.c", _HERE / "c_core_fuzz.c"]
    flags = ("-g", "-O1", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all", f"-I{CORE}")
    subprocess.run(["clang", *flags, *sources, "-o", folder / "fuzz"], check=True)
    (folder / "corpus").mkdir()
    database = vehicle().database
    numbers = {key.identifier | key.extended << 31: number for number, key in enumerate(received(database))}
    for seed in range(20):  # frames as c_core_fuzz.c takes them apart, so that it begins behind the checks
        some = ((numbers[name], data[:64]) for name, data in frames(database, Random(seed), 40) if data is not None)
        whole = b"".join(bytes([number, len(data)]) + data for number, data in some)
        (folder / "corpus" / f"{seed}").write_bytes(whole)
    words = (f"-max_total_time={seconds}", "-max_len=4096", "-print_final_stats=1", "-verbosity=0", "corpus")
    subprocess.run([folder / "fuzz", *words], cwd=folder, check=True)


def main(what: Literal["measure", "fuzz"], *, seconds: int = 60) -> None:
    """Measure the C core, or fuzz it for so many seconds."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        if what == "fuzz":
            fuzz(Path(name), seconds)
        else:
            show(list(measure(Path(name))))


if __name__ == "__main__":
    typer.run(main)
