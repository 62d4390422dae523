"""The C core compared with the node: both get the same frames and codes, and the first result that differs is named."""

from array import array
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path
from random import Random

from bench.c_core import RECORD, SILENCE, frames, record, run, vehicle
from calibrator.errors import ExportError
from calibrator.export.core import Checked, c_text
from ecu_node.bus.wiring import InForce, Mode, branch_signals, wire
from ecu_node.core.correction import correction_plan
from tests.ecu_node.random_vehicles import draw_vehicle

SILENCE_S = 1e7
"""Longer than any time-out."""
STEP_S = 1e-6
"""From frame to frame; no message is silent for long, and no two frames come at the same instant."""


def by_the_node(checked: Checked, given: Iterable[tuple[int, bytes | None]]) -> Iterator[bytes]:
    """Output of the node as a gateway for these frames, as records."""
    corrector = wire(checked.database, InForce(parameters=checked.parameters), 0.0, mode=Mode.GATEWAY)
    sources = {key[0] | key[1] << 31: source for key, source in corrector.sources.items()}
    now_s = 0.0
    for identifier, payload in given:
        now_s += STEP_S
        if payload is None:
            now_s += SILENCE_S
            yield RECORD.pack(identifier, SILENCE, 0, b"")
            continue
        made = sources[identifier].forward(bytearray(payload), now_s)
        result = 2 if made is None else int(made != payload)
        yield RECORD.pack(identifier, len(payload), result, payload if made is None else made)


def check_frames(checked: Checked, program: Path, rng: Random, count: int) -> int:
    """Send random frames through node and core.

    Returns
    -------
    int
        Number of frames that the node changed.

    Raises
    ------
    ValueError
        If node and core make something different of a frame; the message names it.
    """
    given = list(frames(checked.database, rng, count))
    wanted = list(by_the_node(checked, given))
    found = run(program, b"".join(record(*frame) for frame in given))
    if found != b"".join(wanted):
        pairs = zip(given, wanted, RECORD.iter_unpack(found), strict=True)
        frame, want, got = next(item for item in pairs if item[1] != RECORD.pack(*item[2]))
        raise ValueError(f"frame {frame[0]:X} {frame[1]!r}: node {RECORD.unpack(want)}, C core {got}")
    return sum(record[5] == 1 for record in wanted)


def all_codes(checked: Checked, program: Path, *, voltage: int | None = None, bits: int = 24) -> int:
    """Compare what node and core make of every code of each branch whose signal has at most ``bits`` bits.

    With a voltage (code) only branches that are a power are compared, without one only the others. Returns the number
    of codes.

    Raises
    ------
    ValueError
        If node and core make something different of a code; the message names it.
    """
    total = 0
    for number, branch in enumerate(checked.database.layout.branch):
        signals = branch_signals(checked.database, branch, Mode.GATEWAY)
        codes, fault = signals.source, checked.parameters.fault(branch.name)
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
    """Vehicles with signals of all widths from 8 to 24 bits, signed and unsigned, whose highest code is no value."""
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
    """Endless random vehicles, whose numbers fit into the core and whose E2E profiles it knows."""
    while True:
        database, parameters = draw_vehicle(rng, folder, ("P01", "P02"))
        checked = Checked(name="drawn", digest="0" * 64, parameters=parameters, database=database)
        try:
            c_text(checked)
        except ExportError:
            continue
        yield checked
