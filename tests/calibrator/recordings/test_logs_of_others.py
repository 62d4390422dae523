"""Logs and databases as other programs write them, through the command line: one car, a battery and a motor."""

import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from calibrator.files.layout_files import vehicle_database
from ecu_node.database import node_database
from ecu_node.errors import LayoutError
from tests.calibrator.command_here import calibrator, refused, reported

DBC = """VERSION ""
BU_: Car
BO_ 256 Pack: 8 Car
 SG_ Current : 0|16@1- (0.1,0) [-1000|1000] "A" Car
 SG_ Voltage : 16|16@1+ (0.1,0) [0|1000] "V" Car
BO_ 2147484160 Motor: 8 Car
 SG_ Current : 0|16@1- (0.1,0) [-1000|1000] "A" Car
"""
LAYOUT = """
schema = 1
name = "car"
dbc = "car.dbc"
full_scale_a = 100
[[branch]]
name = "battery"
signal = "Pack.Current"
sign = 1
[[branch]]
name = "motor"
signal = "Motor.Current"
sign = -1
"""
COUNT = 40
PERIOD_S = 0.05
START_S = 1_700_000_000.0


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    (tmp_path / "car.dbc").write_text(DBC)
    (tmp_path / "car.toml").write_text(LAYOUT)
    return tmp_path / "car.toml"


def frames() -> Iterator[tuple[float, int, bool, bytes]]:
    """Time [s], identifier, whether it has 29 bits, payload: the battery gives k A, the motor takes 2 A less."""
    for k in range(COUNT):
        pack = (10 * k).to_bytes(2, "little", signed=True) + (4000).to_bytes(2, "little") + bytes(4)
        yield PERIOD_S * k, 0x100, False, pack
        yield PERIOD_S * k + 0.01, 0x200, True, (10 * (k - 2)).to_bytes(2, "little", signed=True) + bytes(6)


def messages() -> Iterator[can.Message]:
    for time_s, number, extended, data in frames():
        yield can.Message(timestamp=START_S + time_s, arbitration_id=number, is_extended_id=extended, data=data)


def write_with_python_can(path: Path) -> None:
    with can.Logger(path) as logger:
        for message in messages():
            logger(message)


def lines(form: str, head: str = "") -> Callable[[Path], None]:
    """Return a writer of a text: a head, then for each frame a line of the given form."""

    def write(path: Path) -> None:
        before = 0.0
        text = []
        for n, (time_s, number, extended, data) in enumerate(frames(), start=1):
            texts = {
                "n": n,
                "time": time_s,
                "us": round(1e6 * time_s) + 265_003_377,
                "ms": 1e3 * time_s,
                "epoch": START_S + time_s,
                "step": time_s - before,
                "second": 20 + time_s,
                "id": f"{number:08X}" if extended else f"{number:03X}",
                "id4": f"{number:08X}" if extended else f"{number:04X}",
                "id8": f"{number:08X}",
                "idx": f"{number:X}x" if extended else f"{number:X}",
                "extended": str(extended).lower(),
                "is_extended": int(extended),
                "data": data.hex(" ").upper(),
                "cells": data.hex(",").upper(),
                "digits": data.hex().upper(),
            }
            text.append(form.format(**texts))
            before = time_s
        path.write_text(head + "\n".join(text) + "\n")

    return write


def packed(path: Path) -> None:
    write_with_python_can(path.with_name("inner.blf"))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path.with_name("inner.blf"), "car/inner.blf")
        archive.writestr("__MACOSX/car/._inner.blf", b"hidden")
        archive.writestr(".checkpoints/inner.blf", b"hidden")
        archive.writestr("../outside.blf", b"not in the archive")


def folder(path: Path) -> None:
    (path / ".checkpoints").mkdir(parents=True)
    for log in (path / "a.asc", path / ".checkpoints" / "a.asc"):
        write_with_python_can(log)


GVRET = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
TRC_1_1 = ";$FILEVERSION=1.1\n;$STARTTIME=45244.5\n;\n;   Message Number\n"
TRC_1_3 = ";$FILEVERSION=1.3\n;$STARTTIME=45244.5\n;\n;   Message Number\n"
TRC_2_0 = ";$FILEVERSION=2.0\n;$STARTTIME=45244.5\n;$COLUMNS=N,O,T,I,d,l,D\n"
TRC_2_1 = ";$FILEVERSION=2.1\n;$STARTTIME=45244.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
ASC = "date Tue Nov 14 10:13:20 pm 2023\nbase hex  timestamps absolute\ninternal events logged\n// version 9.0.0\n"
LOGS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "python-can CSV": ("frames.csv", write_with_python_can),
    "python-can ASC": ("x.asc", write_with_python_can),
    "python-can BLF": ("x.blf", write_with_python_can),
    "python-can TRC": ("x.trc", write_with_python_can),
    "python-can MF4": ("x.mf4", write_with_python_can),
    "python-can candump": ("frames.log", write_with_python_can),
    "SavvyCAN": ("x.csv", lines("{us},{id8},{extended},Rx,0,8,{cells},", GVRET)),
    "GVRET with 0 and 1": ("x.csv", lines("{us},{id8},{is_extended},Rx,0,8,{cells},", "\ufeff" + GVRET)),
    "candump -ta": ("x.log", lines(" ({epoch:.6f})  can0  {id}   [8]  {data}")),
    "candump -tA": ("x.log", lines(" (2023-11-14 22:13:{second:09.6f})  can0  {id}   [8]  {data}")),
    "candump -tz": ("x.txt", lines(" ({time:010.6f})  can0  {id}   [8]  {data}")),
    "candump -td": ("x.log", lines(" ({step:010.6f})  can0  {id}   [8]  {data}")),
    "candump -ta -x -a": ("x.txt", lines(" ({epoch:.6f})  can0  RX - -  {id}   [8]  {data}   '........'")),
    "candump -L in .txt": ("x.txt", lines("({epoch:.6f}) can0 {id}#{digits}")),
    "PEAK TRC 1.0": ("x.trc", lines("{n:6d})  {ms:10.1f}  {id4}  8  {data}", ";   Start time: 14.11.2023\n")),
    "PEAK TRC 1.1": ("x.trc", lines("{n:6d})  {ms:10.1f}  Rx  {id4:>8}  8  {data}", TRC_1_1)),
    "PEAK TRC 1.3": ("x.trc", lines("{n:6d})  {ms:10.3f} 1  Rx  {id4:>8} -  8    {data}", TRC_1_3)),
    "PEAK TRC 2.0": ("x.trc", lines("{n:6d}  {ms:10.3f} DT {id4:>8} Rx 8  {data}", TRC_2_0)),
    "PEAK TRC 2.1": ("x.trc", lines("{n:6d}  {ms:10.3f} DT 1 {id4:>8} Rx -  8    {data}", TRC_2_1)),
    "Vector ASC": ("x.asc", lines("   {time:.6f} 1  {idx:15s} Rx   d 8 {data}  Length = 0 BitCount = 0", ASC)),
    "archive": ("car.zip", packed),
    "folder": ("car", folder),
}


def before(log: Path, layout: Path) -> dict[str, Any]:
    """Figures of the currents by branch, as `calibrator kirchhoff` gives them, and its notices."""
    said = reported("kirchhoff", log, "--layout", layout)
    return {**said["before"], "notices": said["notices"]}


def require_currents(found: dict[str, Any]) -> None:
    """The battery's current is 20 A/s * t; the motor's frames come 10 ms later, so that 0.2 A more seem to be lost."""
    assert found["battery"]["mean_a"] == pytest.approx(20.0, abs=0.1)
    assert found["sum"]["mean_a"] == pytest.approx(2.2, abs=2e-3)
    assert found["sum"]["sd_a"] < 2e-3


@pytest.mark.parametrize("program", LOGS)
def test_logs_written_by_other_programs_give_the_right_currents(tmp_path: Path, layout: Path, program: str) -> None:
    name, write = LOGS[program]
    write(tmp_path / name)
    require_currents(before(tmp_path / name, layout))


def test_logs_in_a_folder_are_read_as_one_recording_and_notes_are_ignored(tmp_path: Path, layout: Path) -> None:
    (tmp_path / "logs").mkdir()
    for name in ("1.csv", "2.csv"):
        LOGS["SavvyCAN"][1](tmp_path / "logs" / name)
    notes = "2026-11-03 12:00 two laps\n2026-11-03 12:40 heater on, 3 of 3\nbattery 80 %\n"
    for name in ("0.txt", "notes.txt"):
        (tmp_path / "logs" / name).write_text(notes)
    found = before(tmp_path / "logs", layout)
    assert found["sum"]["mean_a"] == pytest.approx(2.2, abs=2e-3)
    jumps = "jumps of the clock, or pauses of more than 10 min, which became gaps of 60 s: 1"
    assert any(jumps in notice for notice in found["notices"])


def write_database(path: Path) -> Path:
    database = cantools.database.load_string(DBC, "dbc")
    if path.suffix == ".arxml":  # an AUTOSAR 4 system of the same two frames, which cantools cannot write
        path.write_bytes((Path(__file__).parent / "car.arxml").read_bytes())
    else:
        assert isinstance(database, cantools.database.Database)
        cantools.database.dump_file(database, path)
    return path


@pytest.mark.parametrize("suffix", [".kcd", ".sym", ".arxml"])
def test_database_formats_other_than_dbc_are_read(tmp_path: Path, layout: Path, suffix: str) -> None:
    layout.write_text(LAYOUT.replace("car.dbc", write_database(tmp_path / f"car{suffix}").name))
    write_with_python_can(tmp_path / "x.blf")
    require_currents(before(tmp_path / "x.blf", layout))


def bus_tables(*names: str) -> str:
    channels = {"pt": "can0", "aux": "can1"}
    return "".join(f'[[bus]]\nname = "{name}"\nchannel = "{channels[name]}"\ndbc = "car.dbc"\n' for name in names)


BUSES = bus_tables("pt", "aux")


def of_buses(*names: str) -> str:
    """The layout with a database for each of these buses."""
    return LAYOUT.replace('dbc = "car.dbc"', "") + bus_tables(*names)


def on_buses(path: Path, *channels: tuple[str, int]) -> Path:
    """One candump log of several buses; each has the given number of the car's frames, from the first on."""
    lines_ = [
        (time_s, f"({START_S + time_s:.6f}) {channel} {number:0{8 if extended else 3}X}#{data.hex()}")
        for channel, count in channels
        for time_s, number, extended, data in list(frames())[:count]
    ]
    path.write_text("".join(f"{line}\n" for _, line in sorted(lines_)))
    return path


@pytest.mark.parametrize(("layout_text", "channels", "ignored"), [
    (LAYOUT, [("can0", 80), ("can1", 3)], ["3 frames of other buses ignored (can1)"]),
    (of_buses("pt"), [("can0", 80), ("can1", 40)], ["40 frames of other buses ignored (can1)"]),
    (of_buses("pt", "aux").replace("Pack.", "pt:Pack.").replace("Motor.", "aux:Motor."),
     [("can0", 80), ("can1", 80), ("can2", 7)], ["7 frames of other buses ignored (can2)"]),
])  # fmt: skip
def test_branches_are_read_only_from_the_buses_in_the_layout(
    tmp_path: Path, layout: Path, layout_text: str, channels: list[tuple[str, int]], ignored: list[str]
) -> None:
    layout.write_text(layout_text)
    found = before(on_buses(tmp_path / "x.log", *channels), layout)
    require_currents(found)
    assert [notice for notice in found["notices"] if "buses" in notice] == ignored


def test_ambiguous_bus_is_refused_with_the_layout_lines_to_add(tmp_path: Path, layout: Path) -> None:
    said = refused("kirchhoff", on_buses(tmp_path / "x.log", ("can0", 80), ("can1", 40)), "--layout", layout)
    assert "Pack comes on several buses (frames: can0 40, can1 20)" in said
    assert '[[bus]] with name = "hv", channel = "can0", dbc = "car.dbc"' in said


def test_bus_prefix_is_needed_only_if_two_buses_have_the_message(tmp_path: Path, layout: Path) -> None:
    (tmp_path / "motor.dbc").write_text(DBC.replace("256 Pack", "257 Other"))
    text = of_buses("pt", "aux").replace('can1"\ndbc = "car', 'can1"\ndbc = "motor')
    log = on_buses(tmp_path / "x.log", ("can0", 80), ("can1", 80))
    layout.write_text(text)
    said = refused("kirchhoff", log, "--layout", layout)
    assert "message 'Motor' is in the DBCs of the buses pt and aux; write 'pt:Motor'" in said
    layout.write_text(text.replace("Motor.", "aux:Motor."))
    require_currents(before(log, layout))


def test_branch_can_be_computed_by_a_formula(tmp_path: Path, layout: Path) -> None:
    power = ' SG_ Power : 0|16@1- (0.04,0) [-1000|1000] "kW" Car\n'
    (tmp_path / "car.dbc").write_text(DBC + power)
    formula = 'formula = "p / u * 1000"\nuncertainty = 0.05'
    inputs = '[[input]]\nname = "p"\nsignal = "Motor.Power"\n[[input]]\nname = "u"\nsignal = "Pack.Voltage"\n'
    layout.write_text(LAYOUT.replace('signal = "Motor.Current"', formula) + inputs)
    write_with_python_can(tmp_path / "x.blf")
    assert before(tmp_path / "x.blf", layout)["sum"]["mean_a"] == pytest.approx(2.2, abs=0.02)
    branch = vehicle_database(layout).layout.find_branch("motor")
    assert (branch.computed, branch.uncertainty) == (True, 0.05)


@pytest.mark.parametrize(("change", "words"), [
    (("signal = \"Motor.Current\"", 'formula = "torque / 2"'), "motor: torque is no [[input]] or [[derived]]"),
    (("signal = \"Motor.Current\"", 'formula = "f(1)"'), "motor: formula 'f(1)': 'f(1)' is not allowed"),
    (("sign = -1", 'sign = -1\nformula = "1"'), "'power' and 'voltage', or 'formula'"),
    (("sign = -1", "sign = -1\nuncertainty = 0.1"), "motor: 'uncertainty' is that of a 'formula'"),
    (("sign = -1", 'sign = -1\nunit = "km"'), "branch motor: signal Current is in 'km'; expected A, mA, kA"),
    (("Motor.Current", "aux:Motor.Current"), "no [[bus]] is named 'aux'; known are none"),
    (("full_scale_a", f"{BUSES}\nfull_scale_a"), "unknown key 'full_scale_a'"),
    (('sign = -1', f'sign = -1\n{BUSES}'), "give either 'dbc', or [[bus]] with a 'dbc' each"),
    (('dbc = "car.dbc"', ''), "no 'dbc', so that it fits tables only; give the DBC of the frames"),
    (('dbc = "car.dbc"', 'dbc = "x.kcd"'), "x.kcd: cannot read the DBC: No such file"),
])  # fmt: skip
def test_wrong_layout_is_refused_in_one_line(tmp_path: Path, layout: Path, change: tuple[str, str], words: str) -> None:
    assert change[0] in LAYOUT
    layout.write_text(LAYOUT.replace(*change))
    write_with_python_can(tmp_path / "x.log")
    assert words in refused("kirchhoff", tmp_path / "x.log", "--layout", layout)


def nameless_archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.log", "")
    path.write_bytes(path.read_bytes().replace(b"a.log", b"\0.log"))


@pytest.mark.parametrize(("name", "write", "words"), [
    ("x.log", lines("  can0  {id}   [8]  {data}"), "without times; record it with 'candump -L' or 'candump -ta'"),
    ("x.csv", lines("{us},{id8},true,Rx,0,8,{cells}", GVRET.replace("LEN", "L")), "without the column 'LEN'"),
    ("x.csv", lines("{us},{id8},true,Rx,0,8,ZZ", GVRET), "line 2 is damaged, and 80 of 80 lines are"),
    ("x.zip", lambda path: path.write_bytes(b"PK nothing"), "x.zip: not a readable archive: File is not a zip"),
    ("x.zip", nameless_archive, "x.zip: no logs in it; expected .log, .asc"),
    ("x.zip", lambda path: zipfile.ZipFile(path, "w").close(), "x.zip: no logs in it; expected .log, .asc"),
    ("x.log", lines("{n} {id} {data}"), "line 1 is damaged"),
    ("x.log", lines("({epoch:.6f}) can0 100#{digits}"), "usable frames of battery only; a sum needs two branches"),
    ("x.xlsx", lines("{n}"), "x.xlsx: not a known log format; expected .log, .asc"),
])  # fmt: skip
def test_unusable_log_is_refused_with_one_line(
    tmp_path: Path, layout: Path, name: str, write: Callable[[Path], object], words: str
) -> None:
    write(tmp_path / name)
    assert words in refused("kirchhoff", tmp_path / name, "--layout", layout)


DAMAGED = {name: program for program, (name, _) in LOGS.items() if "." in name}
"""For each file name, the program (the last of several) whose log has that name."""
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "cut at its end": lambda whole: whole[: len(whole) // 2 + 7],
    "damaged in its middle": lambda whole: whole[: len(whole) // 2] + b"\0xx\xffx.xx" + whole[len(whole) // 2 + 30 :],
    "random": lambda whole: bytes(k * k % 251 for k in range(len(whole))),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_log_gives_one_error_line_or_a_notice(tmp_path: Path, layout: Path, name: str, damage: str) -> None:
    log = tmp_path / name
    LOGS[DAMAGED[name]][1](log)
    log.write_bytes(DAMAGES[damage](log.read_bytes()))
    done = calibrator("kirchhoff", log, "--layout", layout, "--json")
    if done.returncode:
        assert (done.returncode, done.stderr.count("\n"), name in done.stderr) == (1, 1, True), done.stderr
        return
    said = json.loads(done.stdout)
    assert damage in {"cut at its end", "damaged in its middle"}
    assert said["before"]["sum"]["mean_a"] == pytest.approx(2.2, abs=0.05)
    if damage == "damaged in its middle":
        assert any("damaged lines or frames left out" in notice for notice in said["notices"])


@pytest.mark.parametrize(("program", "old", "new"), [
    ("candump -ta", b"[8]  14 00 A0 0F 00 00 00 00\n", b"[8]  14 00 A0\n"),
    ("candump -tA", b"2023-11-14 22:13:20.100", b"2023-11-4 22:13:20.100"),
    ("candump -td", b"(000.04", b"(0.0.04"),
    ("SavvyCAN", b",\n265", b",265"),
    ("SavvyCAN", b"00000100,false", b'"0000100,false'),
    ("SavvyCAN", b"00000100,false", b"90000000000100,false"),
    ("PEAK TRC 1.3", b"00000200", b"9000000200"),
])  # fmt: skip
def test_damaged_line_is_skipped_and_counted(
    tmp_path: Path, layout: Path, program: str, old: bytes, new: bytes
) -> None:
    name, write = LOGS[program]
    write(tmp_path / name)
    above, found, below = (tmp_path / name).read_bytes().rpartition(old)
    assert found
    (tmp_path / name).write_bytes(above + new + below)
    notices = before(tmp_path / name, layout)["notices"]
    assert "1 damaged lines or frames left out" in notices


@pytest.mark.parametrize("damage", ["empty", "cut at its end", "random"])
@pytest.mark.parametrize("suffix", [".dbc", ".kcd", ".sym", ".arxml"])
def test_damaged_database_is_refused_with_one_line(tmp_path: Path, layout: Path, suffix: str, damage: str) -> None:
    path = write_database(tmp_path / f"car{suffix}")
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    layout.write_text(LAYOUT.replace("car.dbc", path.name))
    write_with_python_can(tmp_path / "x.blf")
    assert path.name in refused("kirchhoff", tmp_path / "x.blf", "--layout", layout)


@pytest.mark.parametrize(("text", "words"), [
    (of_buses("pt", "aux"), "names several buses; the node corrects the signals of one bus"),
    (of_buses(), "has no 'dbc', so that it fits tables only"),
    (LAYOUT.replace('signal = "Motor.Current"', 'formula = "1"'), "branch motor is computed by a formula"),
    (LAYOUT.replace("car.dbc", "float.dbc"), "branch battery: Pack.Current is a floating-point number"),
])  # fmt: skip
def test_node_refuses_layouts_of_several_or_no_dbc_or_a_computed_or_floating_point_branch(
    layout: Path, text: str, words: str
) -> None:
    layout.with_name("float.dbc").write_text(f"{DBC}SIG_VALTYPE_ 256 Current : 1;\n")
    layout.write_text(text)
    with pytest.raises(LayoutError, match=words):
        node_database(layout)
