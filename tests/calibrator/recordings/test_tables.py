"""Tables as recordings, through the command line: three currents, 0.1 s apart, whose sum is 2 % of the battery's."""

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from asammdf import MDF, Signal

from calibrator.recordings.log_formats import is_table
from calibrator.recordings.tables import read_table
from tests.calibrator.command_here import calibrator, refused, reported

ROWS = 100
BRANCHES = "battery=Ibat,-motor=Imot,-heater=Iheat"
TIME_S = 0.1 * np.arange(ROWS)
BATTERY_A = 100.0 * np.sin(0.5 * TIME_S)


def frame(**columns: Any) -> pd.DataFrame:
    currents = {"Ibat [A]": BATTERY_A, "Imot (A)": 0.9 * BATTERY_A, "Iheat_A": 0.08 * BATTERY_A}
    return pd.DataFrame({"time": TIME_S, **currents, **columns})


def dates() -> pd.DatetimeIndex:
    return pd.date_range("2026-03-29 23:59:55", periods=ROWS, freq="100ms")


def csv(table: pd.DataFrame, **options: Any) -> Callable[[Path], None]:
    return lambda path: table.to_csv(path, **{"index": False, **options})


def decoded_mf4(path: Path) -> None:
    """Channels in two groups with rates of their own, as a logger decodes them."""
    mdf = MDF()
    both = {"Ibat": BATTERY_A, "Imot": 0.9 * BATTERY_A}
    mdf.append([Signal(values, TIME_S, name=name, unit="A") for name, values in both.items()])
    half = slice(None, None, 2)
    mdf.append([Signal(80.0 * BATTERY_A[half], TIME_S[half], name="Iheat", unit="mA")])
    mdf.save(path.with_suffix(".mf4"), overwrite=True)


def sparse(path: Path) -> None:
    """A row per value, as tools write that merge channels of different rates."""
    wide = frame().set_index("time")
    parts = [wide[[name]].set_axis(wide.index + 0.01 * k) for k, name in enumerate(wide)]
    pd.concat(parts).sort_index().to_csv(path)


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("bench/x.csv", frame().to_csv(index=False))


def long() -> pd.DataFrame:
    """More text than what delimiter and decimal sign are told from."""
    return pd.concat([frame()] * 40).assign(time=0.1 * np.arange(40 * ROWS))


def thousands(form: str) -> pd.DataFrame:
    return frame(**{"Ibat [mA]": 1e3 * BATTERY_A}).drop(columns="Ibat [A]").map(form.format)


def whole_thousands(comma: str) -> pd.DataFrame:
    """Whole numbers of mA with separators of thousands, beside times with the other sign before their decimals."""
    table = pd.DataFrame(
        {f"I{name} [mA]": 1e3 * k * BATTERY_A for name, k in (("bat", 1), ("mot", 0.9), ("heat", 0.08))}
    )
    table = table.map(lambda x: f"{x:,.0f}".replace(",", comma))
    return table.assign(time=[f"{x:.1f}".replace(".", "," if comma == "." else ".") for x in TIME_S])


HEAD = "# exported by X\nvehicle;7\n\ntime;Ibat;Imot;Iheat\ns;A;A;A\n"
BODY = frame().to_csv(None, index=False, header=False, sep=";")
UNITS = {"Ibat [A]": "Ibat", "Imot (A)": "Imot", "Iheat_A": "Iheat"}
TABLES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "CSV": ("x.csv", csv(frame())),
    "German CSV": ("x.csv", csv(frame(), sep=";", decimal=",", encoding="latin-1")),
    "tabs, UTF-16": ("x.tsv", csv(frame(), sep="\t", encoding="utf-16")),
    "blanks": ("x.txt", csv(frame().rename(columns=UNITS), sep=" ")),
    "quoted decimal commas": ("x.csv", csv(frame().map(lambda x: f"{x:.6f}".replace(".", ",")), quoting=1)),
    "thousands": ("x.csv", csv(thousands("{:,.3f}"), sep=";")),
    "German thousands": ("x.csv", csv(thousands("{:,.3f}").map(lambda x: x.translate({44: ".", 46: ","})), sep=";")),
    "quoted thousands": ("x.csv", csv(thousands("{:,.3f}"), quoting=1)),
    "whole thousands": ("x.csv", csv(whole_thousands(","), sep=";")),
    "German whole thousands": ("x.csv", csv(whole_thousands("."), sep=";")),
    "Swiss thousands": ("x.csv", csv(thousands("{:,.3f}").map(lambda x: x.replace(",", "'")))),
    "typographic minus": ("x.csv", csv(frame().map(lambda x: str(x).replace("-", "\N{MINUS SIGN}")))),
    "en dash": ("x.csv", csv(frame().map(lambda x: str(x).replace("-", "\N{EN DASH}")))),
    "line ends of an old Mac": ("x.csv", csv(long(), lineterminator="\r")),
    "BOM": ("x.csv", csv(frame(), encoding="utf-8-sig")),
    "archive": ("x.zip", zipped),
    "gzip": ("x.csv.gz", csv(frame())),
    "numbered rows": ("x.csv", csv(frame(), index=True)),
    "comment and units below": ("x.csv", lambda path: path.write_text(HEAD + BODY)),
    "milliseconds": ("x.csv", csv(frame(time=np.arange(ROWS) * 100))),
    "ms in the header": ("x.csv", csv(frame().assign(time=1e3 * TIME_S).rename(columns={"time": "Zeit [ms]"}))),
    "seconds since 1970": ("x.csv", csv(frame(time=1.7e9 + TIME_S))),
    "ms since 1970": ("x.csv", csv(frame(time=1_700_000_000_000 + np.arange(ROWS) * 100))),
    "ISO dates": ("x.csv", csv(frame(time=dates()))),
    "ISO dates with zone": ("x.csv", csv(frame(time=dates().tz_localize("UTC").tz_convert("Europe/Berlin")))),
    "German dates": ("x.csv", csv(frame(time=dates().strftime("%d.%m.%Y %H:%M:%S,%f")), sep=";", decimal=",")),
    "American dates": ("x.csv", csv(frame(time=dates().strftime("%m/%d/%Y %I:%M:%S.%f %p")))),
    "date and time": ("x.csv", csv(frame(Date=dates().strftime("%Y-%m-%d"), time=dates().strftime("%H:%M:%S.%f")))),
    "time without a name for it": ("x.csv", csv(frame().rename(columns={"time": "x"}))),
    "mA": ("x.csv", csv(frame(**{"Iheat [mA]": 80.0 * BATTERY_A}).drop(columns="Iheat_A"))),
    "sparse": ("x.csv", sparse),
    "Parquet": ("x.parquet", lambda path: frame().to_parquet(path)),
    "Parquet, dates as index": ("x.parquet", frame().set_index(dates()).iloc[:, 1:].to_parquet),
    "Arrow": ("x.arrow", lambda path: frame().to_feather(path)),
    "MF4": ("x.mf4", decoded_mf4),
}  # fmt: skip


def before(*arguments: object) -> dict[str, Any]:
    said = reported("kirchhoff", *arguments)
    return {**said["before"], **said}


def require_sum(found: dict[str, Any]) -> None:
    assert found["battery"]["max_a"] == pytest.approx(100.0, abs=0.5)
    assert found["sum"]["max_a"] == pytest.approx(2.0, abs=0.15)  # two rates are interpolated
    assert found["full_scale_a"] == 200.0
    assert found["valid"] >= ROWS - 3


@pytest.mark.parametrize("kind", TABLES)
def test_tables_of_all_formats_give_currents_without_a_layout(tmp_path: Path, kind: str) -> None:
    name, write = TABLES[kind]
    write(tmp_path / name)
    assert is_table(tmp_path / name)
    require_sum(before(tmp_path / name, "--branches", BRANCHES))


@pytest.mark.parametrize(("start", "form", "order"), [
    ("2026-03-12", "%d/%m/%Y", "day"),  # which the 13th, after midnight, decides
    ("2026-03-12", "%m/%d/%Y", "month"),
    ("2026-03-04", "%m-%d-%Y", "month"),
])  # fmt: skip
def test_order_of_day_and_month_is_found_from_all_rows(tmp_path: Path, start: str, form: str, order: str) -> None:
    times = pd.date_range(f"{start} 23:59:55", periods=ROWS, freq="100ms").strftime(f"{form} %H:%M:%S.%f")
    csv(frame(time=times))(tmp_path / "x.csv")
    table = read_table(tmp_path / "x.csv")
    assert f"time 'time', a date, {order} first" in table.found
    require_sum(before(tmp_path / "x.csv", "--branches", BRANCHES))


def test_rows_without_time_or_with_too_many_cells_are_left_out_and_counted(tmp_path: Path) -> None:
    rows = frame().to_csv(index=False).splitlines()
    rows[20] += ",7"
    rows[30] = "," + rows[30].partition(",")[2]
    (tmp_path / "x.csv").write_text("\n".join(rows))
    found = before(tmp_path / "x.csv", "--branches", BRANCHES)
    assert "2 damaged lines or frames left out" in found["notices"]


@pytest.mark.parametrize("index", [
    pd.Index([*range(50), *range(60, ROWS + 10)]), dates(), dates().set_names("time"),
    pd.MultiIndex.from_arrays([["V1"] * ROWS, TIME_S], names=["vehicle", "time"]),
], ids=["row numbers with a gap", "dates", "dates named time", "vehicle and time"])  # fmt: skip
def test_column_of_times_takes_precedence_over_the_index(tmp_path: Path, index: pd.Index) -> None:
    frame().set_axis(index).to_parquet(tmp_path / "x.parquet")
    table = read_table(tmp_path / "x.parquet")
    assert table.time_s == pytest.approx(TIME_S)
    assert table.columns["Ibat [A]"] == pytest.approx(BATTERY_A)


def test_headers_that_differ_only_in_blanks_are_numbered(tmp_path: Path) -> None:
    frame(**{"Ibat [A] ": BATTERY_A}).to_parquet(tmp_path / "x.parquet")
    assert list(read_table(tmp_path / "x.parquet").columns) == ["Ibat.1 [A]", "Imot (A)", "Iheat_A", "Ibat.2 [A]"]


def test_row_with_an_impossible_time_is_left_out(tmp_path: Path) -> None:
    frame(time=np.where(TIME_S == 0.0, 1e300, TIME_S)).to_csv(tmp_path / "x.csv", index=False)
    table = read_table(tmp_path / "x.csv")
    assert (table.without_time, table.clock_steps) == (1, 0)
    assert table.time_s[-1] == pytest.approx(0.1 * (ROWS - 2))


def test_times_without_fractions_of_a_second_are_spread_and_reported(tmp_path: Path) -> None:
    csv(frame(time=TIME_S.astype(int)))(tmp_path / "x.csv")
    notices = " ".join(before(tmp_path / "x.csv", "--branches", BRANCHES)["notices"])
    assert "10 rows share each time: write its fractions of a second" in notices
    time_s = read_table(tmp_path / "x.csv").time_s
    assert time_s - time_s[0] == pytest.approx(TIME_S - TIME_S[0], abs=0.051)


@pytest.mark.parametrize(
    ("step", "rows", "seconds"), [(1, 100, 99), (10, 100, 990), (10, 7000, 69.99), (500, 9, 4), (10**5, 9, 0.8)]
)
def test_time_unit_of_whole_numbers_is_inferred(tmp_path: Path, step: int, rows: int, seconds: float) -> None:
    counts = np.arange(rows)
    csv(pd.DataFrame({"time": step * counts, "a": counts % 7, "b": 1, "note": "ok"}))(tmp_path / "x.csv")
    table = read_table(tmp_path / "x.csv")
    assert table.time_s[-1] == pytest.approx(seconds)
    assert set(table.columns) == {"a", "b"}


LAYOUT = """
schema = 1
name = "car"
full_scale_a = 200
branch = [
    { name = "battery", signal = "Ibat", sign = 1 },
    { name = "motor", signal = "Imot", sign = -1 },
    { name = "heater", power = "Pheat", voltage = "Ubat", sign = -1 },
]
input = [{ name = "speed", signal = "Speed" }]
model_inputs = ["speed"]
"""


def powers() -> pd.DataFrame:
    return frame(**{"Pheat [kW]": 0.08 * BATTERY_A * 0.4, "Ubat [V]": 400.0, "Speed": 50.0}).drop(columns="Iheat_A")


def write_layout_with_dbc(folder: Path, battery: str, motor: str) -> Path:
    """A layout of two currents of the messages Bms (-90 to 90 A) and Inv (mA)."""
    bms, inv = f'{battery} : 0|16@1- (0.1,0) [-90|90] "A" C', f'{motor} : 0|16@1- (1,0) [0|0] "mA" C'
    (folder / "car.dbc").write_text(f'VERSION ""\nBU_: C\nBO_ 1 Bms: 8 C\n SG_ {bms}\nBO_ 2 Inv: 8 C\n SG_ {inv}\n')
    sources = {"battery": (f"Bms.{battery}", 1), "motor": (f"Inv.{motor}", -1)}
    branches = [f'{{ name = "{name}", signal = "{x}", sign = {sign} }}' for name, (x, sign) in sources.items()]
    head = 'schema = 1\nname = "car"\ndbc = "car.dbc"\nfull_scale_a = 100\n'
    (folder / "car.toml").write_text(f"{head}branch = [{', '.join(branches)}]\n")
    return folder / "car.toml"


@pytest.mark.parametrize("names", ["{0}.{1}", "{1}", "CAN1.{0}.{1}"])
def test_columns_of_a_decoded_log_are_matched_to_signals_of_the_dbc(tmp_path: Path, names: str) -> None:
    layout = write_layout_with_dbc(tmp_path, "Pack", "Link")
    columns = {"time": TIME_S, names.format("Bms", "Pack"): BATTERY_A, names.format("Inv", "Link"): 980.0 * BATTERY_A}
    table = pd.DataFrame(columns).astype(object)
    table.iloc[50:60, 1] = "SNA"
    csv(table)(tmp_path / "x.csv")
    found = before(tmp_path / "x.csv", "--layout", layout)
    assert found["sum"]["max_a"] == pytest.approx(1.8, abs=0.04)
    assert found["valid"] < ROWS - 20  # neither texts nor what the DBC's range forbids is a current


def test_column_that_fits_two_messages_is_refused(tmp_path: Path) -> None:
    csv(frame().rename(columns={"Ibat [A]": "Current", "Imot (A)": "Current_0"}))(tmp_path / "x.csv")
    said = refused("kirchhoff", tmp_path / "x.csv", "--layout", write_layout_with_dbc(tmp_path, "Current", "Current"))
    assert "column 'Current' could be Bms.Current and Inv.Current; call columns after message and signal" in said


def test_branch_column_that_holds_texts_is_named_with_the_first_text(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text(LAYOUT)
    csv(powers().assign(**{"Ibat [A]": [f"{value:.1f} A" for value in BATTERY_A]}))(tmp_path / "x.csv")
    said = refused("kirchhoff", tmp_path / "x.csv", "--layout", tmp_path / "car.toml")
    assert "column 'Ibat [A]': its cells are no numbers, such as '0.0 A' in line 2" in said


@pytest.mark.parametrize("form", ["{}-", "({})"])
def test_branch_column_with_some_numbers_that_cannot_be_read_is_named_by_all_commands(
    tmp_path: Path, form: str
) -> None:
    (tmp_path / "car.toml").write_text(LAYOUT)
    minus = [form.format(f"{-value:.1f}") if value < 0.0 else f"{value:.1f}" for value in BATTERY_A]
    csv(powers().assign(**{"Ibat [A]": minus}))(tmp_path / "x.csv")
    table, layout = tmp_path / "x.csv", ("--layout", tmp_path / "car.toml")
    for command in (
        ("kirchhoff", table, *layout),
        ("kirchhoff", table, "--branches", "battery=Ibat,-motor=Imot"),
        ("doctor", "--log", table, *layout),
        ("calibrate", table, *layout, "--trusted", "battery", "--out", tmp_path / "result"),
    ):
        done = calibrator(*command)
        assert done.returncode == 1
        assert "column 'Ibat [A]': 37 of its 100 cells are no numbers, such as '" in done.stdout + done.stderr


def test_table_in_descending_order_is_refused_though_another_column_increases(tmp_path: Path) -> None:
    csv(frame(range=TIME_S).iloc[::-1].assign(soc=TIME_S))(tmp_path / "x.csv")
    said = refused("kirchhoff", tmp_path / "x.csv", "--branches", BRANCHES)
    assert "the time does not increase in column 'time'; sort the rows by it" in said


def test_huge_number_is_left_out(tmp_path: Path) -> None:
    csv(frame(**{"Ibat [A]": [1e200, *BATTERY_A[1:]]}))(tmp_path / "x.csv")
    require_sum(before(tmp_path / "x.csv", "--branches", BRANCHES))


def test_three_decimals_of_a_german_table_are_no_thousands(tmp_path: Path) -> None:
    """Of a charge, whose currents are never below 1 A, with a code for "no value"."""
    currents = [f"{86.0 + 0.1 * k:.3f}".replace(".", ",") for k in range(ROWS)]
    rows = [f"{time};{a};-{a}" for time, a in zip(dates(), currents, strict=True)]
    (tmp_path / "x.csv").write_text("\n".join(["time;Ibat;Imot", *rows[:-1], rows[-1].split(";")[0] + ";255;255"]))
    found = before(tmp_path / "x.csv", "--branches", "Ibat,-Imot")["Ibat"]
    assert found["max_a"] == pytest.approx(255.0)
    assert found["mean_a"] < 100.0


def test_one_damaged_number_is_left_out(tmp_path: Path) -> None:
    csv(frame(**{"Ibat [A]": ["1.2.3", *BATTERY_A[1:]]}))(tmp_path / "x.csv")
    require_sum(before(tmp_path / "x.csv", "--branches", BRANCHES))


@pytest.mark.parametrize("heater", ['power = "Pheat", voltage = "Ubat"', 'formula = "1e3 * Pheat / Ubat"'])
def test_branch_of_a_table_is_a_column_or_a_quotient_of_columns(tmp_path: Path, heater: str) -> None:
    (tmp_path / "car.toml").write_text(LAYOUT.replace('power = "Pheat", voltage = "Ubat"', heater))
    csv(powers())(tmp_path / "x.csv")
    quotient = "battery=Ibat,-motor=Imot,-heater=Pheat*1000/Ubat"
    for branches in (("--layout", tmp_path / "car.toml"), ("--branches", quotient)):
        require_sum(before(tmp_path / "x.csv", *branches))


@pytest.mark.parametrize(("text", "branches", "words"), [
    ("", BRANCHES, "x.csv: the file is empty; a header and rows of numbers are expected"),
    ("time;a;b\n", BRANCHES, "x.csv: no row of numbers below the header"),
    ("0,1,2\n1,2,3\n2,3,4\n", BRANCHES, "x.csv: no header: line 1 has numbers; write the names of the columns"),
    ("hello\nworld\n", BRANCHES, "x.csv: no table: the first line is 'hello'; columns between commas"),
    ("time,a\n0,1\n", "a=a,b=b", "x.csv: 1 rows of values; a header and at least two rows are expected"),
    ("a,b\n3,1\n2,2\n3,1\n", "a,b", "x.csv: no column is the time: none has it in its name and increases"),
    ("time,a\n0,1x\n1,2y\n", "a,b", "beside the time; 'a': its cells are no numbers, such as '1x' in line 2"),
    ("time,Ibat,Imot\n0,1 A,2\n1,2 A,3\n", "Ibat,Imot", "column 'Ibat': its cells are no numbers, such as '1 A' i"),
    ("time;I;J\n0.1;20,930;2\n0.2;-22,360;3\n", "I,J", "column 'I': its cells are no numbers, such as '20,930' in"),
    ("time;I;J\n0,1;1.234;2\n0,2;2.345;3\n", "I,J", "x.csv: column 'I': '1.234' may be 1234 or 1,234; write it wi"),
    ("time,I [A],I (mA)\n0,1,2\n1,2,3\n", "I,Imot", "'I' stands for 'I [A]', 'I (mA)'; write it in full"),
    ("time,I [V],J\n0,1,2\n1,2,3\n", "I,J", "branch I: I is in 'V'; expected A, mA, kA"),
    ("time,I,J\n0,True,2\n1,False,3\n", "I,J", "branch I: I is in 'on/off'; expected A, mA, kA"),
])  # fmt: skip
def test_unusable_table_or_wrong_branches_are_refused(tmp_path: Path, text: str, branches: str, words: str) -> None:
    (tmp_path / "x.csv").write_text(text)
    assert words in refused("kirchhoff", tmp_path / "x.csv", "--branches", branches)


@pytest.mark.parametrize("suffix", [".parquet", ".feather", ".mf4", ".csv.gz"])
def test_damaged_table_is_refused_with_one_line(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"x{suffix}").write_bytes(gzip.compress(frame().to_csv(index=False).encode())[:1500])
    said = refused("kirchhoff", tmp_path / f"x{suffix}", "--branches", "a,b")
    assert f"x{suffix}: not a readable" in said
