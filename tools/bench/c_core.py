"""The C core beside the node: the same bits, and how large and how fast it is.

python -m bench.c_core compare            all codes of all signals of 8 to 24 bits, and 10^7 random frames
python -m bench.c_core measure            bytes and instructions per frame (gcc, binutils, valgrind)
python -m bench.c_core fuzz --seconds S   libFuzzer with the sanitizers of memory and undefined behaviour (clang)
"""

import argparse
import re
import subprocess
import tempfile
from array import array
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice, product
from pathlib import Path
from random import Random
from struct import Struct

import ecu_node
from bench.fuzz_vehicles import draw_vehicle
from bench.row import LAYOUT, Row, show
from bench.true_parameters import true_parameters
from calibrator.errors import ExportError
from calibrator.export.core import Checked, c_text
from ecu_node.bus.wiring import InForce, Mode, branch_signals, received, wire
from ecu_node.core.correction import correction_plan
from ecu_node.core.e2e import protection_of
from ecu_node.core.signals import BitPlace, bit_place
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters

CORE = Path(ecu_node.__file__).parent / "c"
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")
RECORD = Struct("<IBB64s")
"""A frame: identifier (bit 31: of 29 bits), length, result (0 as it was, 1 changed, 2 held back), payload."""

_HERE = Path(__file__).parent
_SILENCE = 255
"""As a length: all messages were silent for so long that counters and voltages are forgotten."""
_SILENCE_S = 1e7  # longer than any time-out


def vehicle(layout: Path = _HERE / "c_core_vehicle.toml") -> Checked:
    """A vehicle with a fault of each sensor but one; by default one with all that the core knows."""
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
    """Frames as a bus might have them, and worse: jumps of counters, changed bits, cut payloads, silences (None)."""
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
    """A code at the ends of the width, around 0, or small."""
    edge = (place.lowest, place.highest, 0)[int(rng.random() * 3)] + int(rng.random() * 9) - 4
    place.put(payload, min(max(edge, place.lowest), place.highest))


def by_the_node(checked: Checked, given: Iterable[tuple[int, bytes | None]]) -> Iterator[bytes]:
    """What the node makes of frames as a gateway, as records."""
    corrector = wire(checked.database, InForce(parameters=checked.parameters), 0.0, mode=Mode.GATEWAY)
    sources = {key[0] | key[1] << 31: source for key, source in corrector.sources.items()}
    now_s = 0.0
    for identifier, payload in given:
        if payload is None:
            now_s += _SILENCE_S
            yield RECORD.pack(identifier, _SILENCE, 0, b"")
            continue
        made = sources[identifier].forward(bytearray(payload), now_s)
        result = 2 if made is None else int(made != payload)
        yield RECORD.pack(identifier, len(payload), result, payload if made is None else made)


def check_frames(checked: Checked, program: Path, rng: Random, count: int) -> int:
    """Send random frames through node and core.

    Returns
    -------
    int
        How many were changed.

    Raises
    ------
    ValueError
        If they differ in one frame, naming it.
    """
    given = list(frames(checked.database, rng, count))
    wanted = list(by_the_node(checked, given))
    found = run(program, b"".join(_record(*frame) for frame in given))
    if found != b"".join(wanted):
        pairs = zip(given, wanted, RECORD.iter_unpack(found), strict=True)
        frame, want, got = next(item for item in pairs if item[1] != RECORD.pack(*item[2]))
        raise ValueError(f"frame {frame[0]:X} {frame[1]!r}: node {RECORD.unpack(want)}, C core {got}")
    return sum(record[5] == 1 for record in wanted)


def _record(identifier: int, payload: bytes | None) -> bytes:
    return RECORD.pack(identifier, _SILENCE if payload is None else len(payload), 0, payload or b"")


def build(checked: Checked, folder: Path, *, compiler: str = "gcc", flags: tuple[str, ...] = ("-O2",)) -> Path:
    """Compile core, exported data and driver with all warnings as errors; the program."""
    (folder / "hv_calibration.c").write_text(c_text(checked))
    driver, objects = _HERE / "c_core_driver.c", []
    for source in (CORE / "hv_correction.c", folder / "hv_calibration.c", driver):
        objects.append(folder / f"{source.stem}.o")
        strict = () if source == driver else FLAGS
        subprocess.run([compiler, *strict, *flags, "-g", f"-I{CORE}", "-c", source, "-o", objects[-1]], check=True)
    subprocess.run([compiler, *flags, "-no-pie", *objects, "-o", folder / "driver"], check=True)
    return folder / "driver"


def run(program: Path, given: bytes, *words: str) -> bytes:
    """Run the driver, and return what it writes."""
    return subprocess.run([program, *words], input=given, stdout=subprocess.PIPE, check=True).stdout


def all_codes(checked: Checked, program: Path, *, voltage: int | None = None, bits: int = 24) -> int:
    """Compare all codes of all branches of up to so many bits, and return how many they were.

    Raises
    ------
    ValueError
        If node and core differ in one, naming it.
    """
    total = 0
    for number, branch in enumerate(checked.database.layout.branch):
        signals = branch_signals(checked.database, branch, Mode.GATEWAY)
        codes, fault = signals.source, checked.fault(branch.name)
        plan, place = correction_plan(signals, fault), codes.place
        if place.length > bits or (branch.voltage is not None) != (voltage is not None):
            continue
        passed = not fault.applied or not (signals.voltage is None or signals.voltage.is_value(voltage or 0))
        words = (str(number), str(place.lowest), str(place.highest), "-" if voltage is None else str(voltage))
        found = array("q", run(program, b"", *words))
        apply, is_value, u = plan.apply, codes.is_value, voltage or 0
        width = range(place.lowest, place.highest + 1)
        wanted = array("q", [code if passed or not is_value(code) else apply(code, u) for code in width])
        if found != wanted:
            code, got, want = next(item for item in zip(width, found, wanted, strict=True) if item[1] != item[2])
            raise ValueError(f"{branch.source}: code {code}: node {want}, C core {got}")
        total += len(found)
    return total


def widths(folder: Path) -> Iterator[Checked]:
    """Vehicles that have between them signals of 8 to 24 bits, signed and unsigned, with names at an end."""
    for lengths in (range(8, 14), range(14, 20), range(20, 25)):
        messages, tables, branches = [], [], []
        for number, (length, sign) in enumerate(product(lengths, "+-"), start=1):
            signal = f'I : 0|{length}@1{sign} (0.5,{-(1 << length - 2) if sign == "+" else 0}) [0|0] "A" X'
            messages.append(f"BO_ {number} M{number}: 8 Sensor\n SG_ {signal}\n")
            tables.append(f'VAL_ {number} I {(1 << length - (sign == "-")) - 1} "SNA";\n')
            branches.append(f'{{ name = "b{number}", sign = 1, signal = "M{number}.I" }}')
        (folder / "widths.dbc").write_text("".join(['VERSION ""\nBU_: Sensor X\n', *messages, *tables]))
        text = f'schema = 1\nname = "w"\ndbc = "widths.dbc"\nfull_scale_a = 50.0\nbranch = [{", ".join(branches)}]\n'
        (folder / "widths.toml").write_text(text)
        yield vehicle(folder / "widths.toml")


def drawn_vehicles(rng: Random, folder: Path) -> Iterator[Checked]:
    """Random vehicles without end, of which the core has room for all signals and knows all protections."""
    while True:
        database, parameters = draw_vehicle(rng, folder, ("P01", "P02"))
        checked = Checked(name="drawn", digest="0" * 64, parameters=parameters, database=database)
        try:
            c_text(checked)
        except ExportError:
            continue
        yield checked


def compare(folder: Path, count: int) -> list[Row]:
    """All codes, and random frames of the vehicle with everything and of random ones."""
    codes = sum(all_codes(checked, build(checked, folder)) for checked in widths(folder))
    whole = vehicle()
    program, rng, done, changed = build(whole, folder), Random(3), 0, 0
    codes += all_codes(whole, program) + sum(all_codes(whole, program, voltage=u) for u in (0, 1, 4000, 8000, 16383))
    for checked in drawn_vehicles(rng, folder):
        for subject in (whole, checked):
            changed += check_frames(subject, build(subject, folder), rng, 100_000)
            done += 100_000
        if done >= count:
            break
    return [
        Row(name="C core = node, codes compared, no difference", value=codes, unit="1"),
        Row(name="C core = node, random frames, no difference", value=done, unit="1"),
        Row(name="of these changed", value=changed, unit="1"),
    ]


def measure(folder: Path, count: int = 10_000, flags: Sequence[str] = ("-Os", "-O2")) -> Iterator[Row]:
    """Bytes of code, and instructions of a frame of the project's own battery message, with and without E2E."""
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
        given = (_record(*frame) for frame in frames(checked.database, Random(4), 40 * count) if frame[0] == battery)
        options = ("--collect-atstart=no", "--toggle-collect=hv_forward", "--quiet", f"--callgrind-out-file={out}")
        command: list[str | Path] = ["valgrind", "--tool=callgrind", *options, program]
        subprocess.run(command, input=b"".join(islice(given, count)), capture_output=True, check=True)
        (instructions, *_) = re.findall(r"^(?:summary|totals): (\d+)", out.read_text(), flags=re.MULTILINE)
        yield Row(name=f"C core, gcc {flag}, frame {what}", value=int(instructions) / count, unit="instructions")


def fuzz(folder: Path, seconds: int) -> None:
    """Any calibration and any frames, until the time is over or something is wrong."""
    (folder / "hv_calibration.c").write_text(c_text(vehicle()))
    sources = [CORE / "hv_correction.c", folder / "hv_calibration.c", _HERE / "c_core_fuzz.c"]
    flags = ("-g", "-O1", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all", f"-I{CORE}")
    subprocess.run(["clang", *flags, *sources, "-o", folder / "fuzz"], check=True)
    (folder / "corpus").mkdir()
    whole = b"".join(data[:64] for _, data in frames(vehicle().database, Random(5), 60) if data)
    (folder / "corpus" / "one").write_bytes(whole)
    words = (f"-max_total_time={seconds}", "-max_len=4096", "-print_final_stats=1", "-verbosity=0", "corpus")
    subprocess.run([folder / "fuzz", *words], cwd=folder, check=True)


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("compare", "measure", "fuzz"))
    parser.add_argument("--frames", type=int, default=10_000_000, help="random ones to compare; 10^7 without it")
    parser.add_argument("--seconds", type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        if arguments.what == "fuzz":
            fuzz(Path(name), arguments.seconds)
        elif arguments.what == "compare":
            show(compare(Path(name), arguments.frames))
        else:
            show(list(measure(Path(name))))


if __name__ == "__main__":
    main()
