"""Mistakes of a user, over all commands: one line each, which says what, where, and what to do; never a traceback."""

import math
from pathlib import Path

import pytest

from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from tests.ecu_node.processes import Done, ecu_node
from tests.ecu_node.vehicles import LAYOUT, parameters_for
from tests.update.repo import calibrator

MISTAKES = [
    # layouts
    ("calibrator import logs --layout none.toml --out x", 1, "none.toml: cannot read the layout: No such file"),
    ("calibrator import logs --layout folder --out x", 1, "folder: cannot read the layout: it is a folder; a file is"),
    ("calibrator import logs --layout empty --out x", 1, "empty: 'schema' is missing; see the page 'Layout' of the"),
    ("calibrator import logs --layout noise --out x", 1, "noise: not a layout: the file is not UTF-8 text; see the"),
    ("calibrator import logs --layout cut.json --out x", 1, "cut.json: not TOML: "),
    ("ecu-node template --layout DBC --vehicle v", 1, "hv_powertrain.dbc: not TOML: "),
    # numbers
    ("calibrator simulate --vehicles 0 LAYOUT --out x", 2, "'--vehicles': 0: expected a whole number from 1 to 100000"),
    ("ecu-node monitor LAYOUT --channel c --once 0", 2, "--once: '0': expected a number of seconds above 0"),
    # the layout is missing too, and is not complained of: nothing has been looked at yet
    ("calibrator simulate --vehicles 2 --noise inf NONE --out x", 2, "'--noise': inf: expected a number from 0 to 1"),
    ("calibrator simulate --vehicles 2 --unmeasured nan 1 NONE --out x", 2, "mean and standard deviation from 0 to"),
    ("calibrator simulate --vehicles 2 --unmeasured 1 -1 NONE --out x", 2, "mean and standard deviation from 0 to"),
    ("calibrator simulate --vehicles 2 --magnitude 0.2 0.1 NONE --out x", 2, "'--magnitude': 0.2 0.1: expected 0 <="),
    ("calibrator simulate --vehicles 3 --symmetric LAYOUT --out x", 1, "multiple of 4"),
    ("calibrator simulate --vehicles 3 --currents 6 LAYOUT --out x", 1, "2 to 5 are possible"),
    # options and commands
    ("calibrator calibrate logs LAYOUT --out x --branches battery,battery", 2, "battery is named twice"),
    ("calibrator calibrate logs LAYOUT --out x --branches battery,", 2, "names of branches with commas between them"),
    ("calibrator calibrate logs LAYOUT --out x PUBLISHED --trusted V1", 2, "belongs to --method posterior, not"),
    ("calibrator experiment sparsity --drives store --out x", 2, "--drives: sparsity takes the built-in vehicle"),
    ("calibrator experiment snr NONE --out x", 2, "--layout: snr takes the built-in vehicle; this is only for real"),
    ("calibrator fly", 2, "No such command 'fly'; see 'calibrator --help'"),
    ("calibrator calibrate LAYOUT --out x", 2, "Missing argument 'FLEET'; see 'calibrator calibrate --help'"),
    ("calibrator calibrate a b LAYOUT --out x", 2, "unexpected extra argument"),
    ("calibrator calibrate a LAYOUT --out x --method both", 2, "'both' is not one of 'posterior', 'published'"),
    ("calibrator calibrate logs LAYOUT --out x --trusted v1,battery", 2, "names vehicles and branches (battery); name"),
    ("calibrator score folder --truth", 2, "--truth"),
    ("ecu-node fly", 2, "invalid choice: 'fly'"),
    ("ecu-node", 2, "; see 'ecu-node --help'"),
    ("ecu-node check", 2, "; see 'ecu-node check --help'"),
    ("ecu-node run --nonsense", 2, "; see 'ecu-node run --help'"),
    ("ecu-node run LAYOUT", 2, "required: --channel; see 'ecu-node run --help'"),
    ("ecu-node run LAYOUT --channel c --params v1.json", 2, "--params names a file that nobody signed: give --state"),
    ("ecu-node run LAYOUT --channel c --state s --unsigned", 2, "--state holds signed parameters; leave --unsigned"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --gateway c", 2, "c is the bus of the sensors itself; two"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --gateway d --listen-only", 2, "a gateway must pass frames on"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --telemetry udp://h", 2, "is expected, found 'udp://h'"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --telemetry udp://:5000", 2, "is expected, found 'udp://:5000"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --telemetry mqtt://h:1", 2, "is expected, found 'mqtt://h:1'"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --telemetry=", 2, "is expected, found none"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --summary=", 2, "--summary: a folder is expected, found none"),
    ("ecu-node run LAYOUT --channel c --state=", 2, "--state: a folder is expected, found none"),
    ("ecu-node clear --state=", 2, "--state: a folder is expected, found none"),
    ("ecu-node inspect --state=", 2, "--state: a folder is expected, found none"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --bitrate 0", 2, "--bitrate: '0': expected a number of bit/s, such as"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --bitrate abc", 2, "--bitrate: 'abc': expected a number of bit/s, such"),
    ("ecu-node run LAYOUT --channel c UNSIGNED --data-bitrate=-5", 2, "--data-bitrate: '-5': expected a number of bit"),
    ("ecu-node monitor LAYOUT --channel c --json", 2, "--json needs --once SECONDS"),
    (f"ecu-node template LAYOUT --vehicle {'v' * 65}", 2, "of at most 64 characters, found 65 characters"),
    ("ecu-node template LAYOUT --vehicle \a", 2, r"printable and of at most 64 characters, found '\x07'"),
    ("ecu-node template LAYOUT --vehicle=", 2, "--vehicle: the identity of the vehicle is expected"),
    # places for results
    ("calibrator simulate --vehicles 2 LAYOUT --out empty/x", 1, "/empty is a file; choose another folder"),
    ("calibrator calibrate none LAYOUT --out empty/x", 1, "/empty is a file; choose another folder"),
    ("calibrator import none.log LAYOUT --out empty/x", 1, "/empty is a file; choose another folder"),
    ("calibrator experiment snr --out empty/x", 1, "/empty is a file; choose another folder"),
    # fleets, results, truth
    ("calibrator calibrate none LAYOUT --out x", 1, "none: no such folder, store of drives or store of summaries"),
    ("calibrator calibrate empty LAYOUT --out x", 1, "empty: not a known log format; expected .log"),
    ("calibrator calibrate folder LAYOUT --out folder/x --since folder", 1, "folder: "),
    ("calibrator params folder v1 --out x", 1, "run.json: not a result of 'calibrator calibrate': No such file"),
    ("calibrator params folder v1 --out x", 1, "; name a folder that 'calibrator calibrate --out' wrote"),
    ("calibrator score folder --truth none.json", 1, "; name the truth.json that 'calibrator simulate' wrote"),
    ("calibrator score folder --truth cut.json", 1, "cut.json: not a truth.json of 'calibrator simulate': "),
    ("calibrator summarise logs LAYOUT --out empty", 1, "empty: is a file; name a folder for the summaries, or a URL"),
    ("calibrator summarise logs LAYOUT --out x --bank cut.json", 1, "cut.json: no filter bank"),
    ("calibrator identify logs LAYOUT --out folder", 1, "folder: is a folder; name a file in it"),
    ("calibrator import none LAYOUT --out x", 1, "none of the logs could be used, for the reasons given above"),
    # looking at a recording
    ("calibrator kirchhoff none.csv --branches battery=I,motor=J", 1, "none.csv: no such file"),
    ("calibrator kirchhoff /dev/null --branches battery=I,motor=J", 1, "/dev/null: a pipe or device, which is not"),
    ("calibrator kirchhoff empty.csv --branches battery=I,motor=J", 1, "empty.csv: "),
    ("calibrator kirchhoff noise --branches battery=I,motor=J", 1, "noise: no table: only one line"),
    ("calibrator kirchhoff logs/v1/drive.log --branches battery=I,motor=J", 2, "a log of frames needs --layout"),
    ("calibrator kirchhoff texts.csv --branches battery=I,motor=J", 1, "texts.csv: "),
    ("calibrator kirchhoff drive.csv", 2, "--branches"),
    ("calibrator kirchhoff drive.csv --branches battery=Ibat", 1, "two or more are expected"),
    ("calibrator kirchhoff drive.csv --branches battery,motor", 1, "there is no column 'battery'; the columns are"),
    ("calibrator kirchhoff drive.csv --branches battery=Ibat,motor=Iother", 1, "Iother"),
    ("calibrator kirchhoff drive.csv --branches battery=Ibat,motor=Ibat", 1, "both read Ibat"),
    ("calibrator kirchhoff drive.csv --branches battery=Ibat,battery=Imot", 1, "battery is named twice"),
    ("calibrator kirchhoff drive.csv CURRENTS --plot folder", 2, "folder: expected a file name that ends with .html"),
    ("calibrator kirchhoff drive.csv CURRENTS --plot drive.csv", 2, "drive.csv"),
    ("calibrator kirchhoff drive.csv CURRENTS --plot sum.doc", 2, "sum.doc"),
    ("calibrator kirchhoff drive.csv CURRENTS --table drive.csv", 2, "drive.csv"),
    ("calibrator kirchhoff drive.csv CURRENTS --parameters noise", 2, "--parameters belong to a layout"),
    ("calibrator kirchhoff other.csv CAR", 1, "there is no column 'Imot'; the columns are 'Iother', 'Ibat'"),
    ("calibrator kirchhoff CAR", 2, "Missing argument 'LOG'"),
    ("calibrator kirchhoff drive.csv --branches sum=Ibat,motor=Imot", 1, "branch 'sum' is called like the sum"),
    ("calibrator layout init none.dbc --log drive.csv --out x", 1, "none.dbc"),
    ("calibrator layout init none.csv --out x", 1, "none.csv: no such file"),
    ("calibrator layout init noise --log drive.csv --out x", 1, "noise"),
    ("calibrator layout init drive.csv CURRENTS --out drive.csv", 1, "drive.csv"),
    ("calibrator layout init car.dbc gvret.csv --out x", 2, "calibrator layout init car.dbc --log gvret.csv;"),
    ("calibrator layout init still.csv --out x.toml", 1, "still.csv"),
    ("calibrator doctor LAYOUT --log none.log", 1, "none.log: no such file"),
    ("calibrator doctor LAYOUT --log /dev/null", 1, "; save what it gives to a file"),
    ("calibrator doctor LAYOUT --log empty", 1, "empty: not a known log format"),
    ("calibrator report folder", 1, "not a result of 'calibrator calibrate'"),
    ("calibrator report none", 1, "none"),
    ("calibrator report v1.json", 1, "not a result of 'calibrator calibrate': Not a directory; name a folder that"),
    # one junction
    ("calibrator calibrate drive.csv CAR --out x --trusted gearbox", 1, "--trusted gearbox: no such branch"),
    ("calibrator calibrate drive.csv CAR --out x --trusted battery --expected-faults 0.2", 2, "is for a fleet"),
    ("calibrator calibrate drive.csv CAR --out x --meter battery", 1, "--meter battery: one folder of recordings"),
    ("calibrator calibrate drive.csv CAR --out x --readings none.csv", 1, "none.csv"),
    ("calibrator calibrate short.csv CAR --out x", 1, "at least 5 s are needed"),
    ("calibrator replay drive.csv --interface virtual --channel c", 1, "a table"),
    ("calibrator replay drive.csv --channel c --speed=-1", 2, "'--speed': -1: expected a number from 0 to 1"),
    # parameter files
    ("calibrator export v1.json LAYOUT --format hex --out x", 2, "--format hex needs --elf PROGRAM"),
    ("calibrator export v1.json LAYOUT --format dcm --elf v1.json --out x", 2, "--format dcm takes no --elf PROGRAM"),
    ("calibrator export none.json LAYOUT --format dcm --out x", 1, "no such parameter file; name one that is there"),
    ("calibrator export empty LAYOUT --format dcm --out x", 1, "empty: not a parameter file: it is empty; correct it"),
    ("calibrator export v1.json LAYOUT --format xls --out x", 2, "'xls' is not one of 'c', 'hex', 'a2l', 'dcm'"),
    ("calibrator export v1.json LAYOUT --format dcm --out folder", 1, "folder: is "),
    ("calibrator export v1.json LAYOUT --format dcm --out x --vehicle v2", 1, "v2"),
    # keys and repositories
    ("calibrator repository key a/b --no-passphrase --out x", 2, "'a/b': a name for a file is expected"),
    ("calibrator repository publish x --key none.key", 1, "none.key: cannot read the private key: No such file"),
    ("calibrator repository publish x --key empty", 1, "empty: cannot be used as a private key (PEM, PKCS #8)"),
    ("calibrator repository rotate x root --public empty", 1, "x: no repository; make one with"),
    (
        "calibrator repository add empty v1.json --json",
        1,
        "empty: no repository; make one with 'calibrator repository init'",
    ),
    ("ecu-node provision --vehicle v1 --root none.json --state s", 1, "none.json: cannot read the root: No such file"),
    ("ecu-node update v1.json --state none LAYOUT", 1, "none: cannot be used as state: No such file or"),
    ("ecu-node inspect --state none", 1, "none: no state of a vehicle there; make one with 'ecu-node provision'"),
    ("ecu-node faults --state none", 1, "none: neither a state nor faults there; name the folder of 'ecu-node run"),
    ("ecu-node faults --state folder", 1, "folder: neither a state nor faults there; name the folder of 'ecu-node run"),
    ("ecu-node clear --state folder", 1, "folder: neither a state nor faults there; name the folder of 'ecu-node run"),
    ("ecu-node monitor LAYOUT --channel x --interface kvaser --bitrate 500000", 1, "an integer; see --channel, CAN_"),
    ("ecu-node run LAYOUT --channel c --interface pigeon UNSIGNED", 1, "pigeon c: cannot open"),
    ("ecu-node run LAYOUT --channel nobus0 UNSIGNED", 1, "socketcan nobus0: cannot open the bus: "),
    ("ecu-node run NONE --channel nobus0 UNSIGNED", 1, "none.toml: cannot read the layout: No such"),
]
"""Command, exit code, and some words of its error line."""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what a user may name by mistake, in which the commands run."""
    write_parameters(parameters_for(read_database(read_layout(LAYOUT)), battery=(0.05, 2.3)), tmp_path / "v1.json")
    for name in ("empty", "empty.csv", "logs/v1/drive.log"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "texts.csv").write_text("time_s,I,J\n0.0,on,off\n0.1,on,off\n")
    rows = [f"{0.1 * k:.1f},{10 * math.sin(k / 7):.2f},{10 * math.sin(k / 7):.2f},0.0" for k in range(600)]
    for name, number in {"drive.csv": 600, "short.csv": 30}.items():
        (tmp_path / name).write_text("\n".join(["time_s,Ibat,Imot,Iheat", *rows[:number]]))
    (tmp_path / "other.csv").write_text("\n".join(["time_s,Ibat,Iother,Iheat", *rows]))
    (tmp_path / "still.csv").write_text("\n".join(["time_s,speed", *(f"{0.1 * k:.1f},0.0" for k in range(600))]))
    branches = '{ name = "battery", signal = "Ibat", sign = 1 }, { name = "motor", signal = "Imot", sign = -1 }'
    (tmp_path / "car.toml").write_text(f'schema = 1\nname = "car"\nfull_scale_a = 100.0\nbranch = [{branches}]\n')
    (tmp_path / "folder").mkdir()
    (tmp_path / "noise").write_bytes(bytes(range(128, 256)))
    (tmp_path / "cut.json").write_bytes((tmp_path / "v1.json").read_bytes()[:200])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command: str) -> Done:
    command = command.replace("CURRENTS", "--branches battery=Ibat,-motor=Imot").replace("CAR", "--layout car.toml")
    command = command.replace("NONE", "--layout none.toml").replace("PUBLISHED", "--method published")
    command = command.replace("UNSIGNED", "--params v1.json --unsigned")
    words = command.replace("LAYOUT", f"--layout {LAYOUT}").replace("DBC", str(LAYOUT.with_suffix(".dbc"))).split()
    return {"ecu-node": ecu_node, "calibrator": calibrator}[words[0]](*words[1:])


@pytest.mark.parametrize(("command", "code", "words"), MISTAKES)
def test_mistake_is_reported_in_one_line_and_writes_nothing(command: str, code: int, words: str, place: Path) -> None:
    before = sorted(path.name for path in place.rglob("*"))
    done = run(command)
    (line,) = done.err.splitlines()
    assert done.code == code
    assert not done.out or "given above" in line
    assert line.startswith(command.partition(" ")[0])
    assert words in line
    assert sorted(path.name for path in place.rglob("*")) == before
