"""The progress bar at any width, and the lines that a log gets instead."""

import math
import re

import pytest

from calibrator.terminal.progress import one_pass, progress_bar, shown
from calibrator.terminal.text import Notice, few_reasons, figure, left_out_text, merged_notices, reasons_text
from tests.calibrator.screen import Screen


def test_progress_without_a_terminal_is_printed_as_lines_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 5.0, 11.0, 12.0, 40.0, 41.0])
    monkeypatch.setattr("calibrator.terminal.progress.time.monotonic", lambda: next(clock))
    with progress_bar("read drives", 8, "vehicles") as done:
        for number in (1, 2, 3, 8, 8):
            done(number)
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines() == [
        "read drives: 2 of 8 vehicles, 11 s, 33 s left",
        "read drives: 8 of 8 vehicles, 40 s, 0 s left",
    ]


def test_progress_of_each_pass_shows_its_number_and_the_number_of_passes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("calibrator.terminal.progress.WORTH_A_LINE_S", 0.0)
    with one_pass(1, 2), progress_bar("learn the fleet", None):
        pass
    with one_pass(2, 2):
        assert list(shown("ab", "calibrate", 2, "vehicles")) == ["a", "b"]
    with progress_bar("import", 1, "logs") as done:
        done(1)
    starts = [text.partition(",")[0] for text in capsys.readouterr().err.splitlines()]
    assert starts == ["1/2 learn the fleet", "2/2 calibrate: 2 of 2 vehicles", "import: 1 of 1 logs"]


IN_TERMINAL = """
from calibrator.terminal import progress
from calibrator.terminal.progress import progress_bar
progress.WORTH_A_LINE_S = 0.0
with progress_bar("read drives", 4, "vehicles") as done:
    done(2)
    if {interrupt}:
        raise KeyboardInterrupt
    done(4)
"""


def in_terminal(*, interrupt: bool = False, columns: int = 80) -> str:
    return Screen("-c", IN_TERMINAL.format(interrupt=interrupt), columns=columns).ended()[1]


@pytest.mark.parametrize("columns", [30, 50, 80, 120])
def test_progress_bar_is_coloured_and_fits_the_terminal_width(columns: int) -> None:
    raw = in_terminal(columns=columns)
    assert re.search(r"\x1b\[[0-9;]*3[0-9;]*m", raw)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", raw)
    lines = [line.rstrip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    assert max(map(len, lines)) <= columns
    assert lines[-1].startswith("read drives")
    assert "4/4" in lines[-1]
    assert ("vehicles" in lines[-1]) == (columns >= 70)


def test_ctrl_c_restores_the_cursor_on_a_new_line() -> None:
    before, _, _ = in_terminal(interrupt=True).partition("Traceback")
    assert before.rindex("\x1b[?25h") > before.rindex("\x1b[?25l")
    assert before.rstrip("\x1b[?25h").endswith("\n")


# Texts


@pytest.mark.parametrize(("value", "digits", "text"), [
    (50.0, 1, "50"), (2.4, 3, "2.4"), (0.034567, 2, "0.035"), (4096.4, 2, "4,096"), (-123.456, 3, "-123"),
    (0.0, 3, "0"), (-1e-12, 3, "0"), (1e7, 3, "10,000,000"), (math.nan, 3, "-"),
])  # fmt: skip
def test_numbers_are_formatted_with_significant_digits_and_separators(value: float, digits: int, text: str) -> None:
    assert figure(value, digits) == text


def test_first_five_reasons_are_listed_and_the_rest_counted() -> None:
    reasons = {f"V{j}": "cut" for j in range(7)}
    five = "; V0: cut; V1: cut; V2: cut; V3: cut; V4: cut"
    assert few_reasons({}) == ""
    assert few_reasons(dict(list(reasons.items())[:5])) == five
    assert few_reasons(reasons) == f"{five}; and 2 more"


def test_reason_that_many_vehicles_share_is_printed_on_one_line() -> None:
    reasons = dict.fromkeys((f"V{k:03}" for k in range(1, 45)), "too short")
    line = "V001, V002, V003, V004, V005, V006 and 38 more: too short"
    assert left_out_text(reasons) == f"left out:\n  {line}"
    assert reasons_text("cannot tell", reasons) == f"cannot tell:\n  {line}"
    assert left_out_text({}) == ""


@pytest.mark.parametrize(("drives", "text"), [
    (["V1/monday"], "V1/monday: 1 of 2 frames"),
    (["V1/monday", "V1/tuesday"], "in 2 drives of V1: 2 of 4 frames"),
    (["V1/monday", "V1/tuesday", "V2/monday"], "in 3 drives of 2 vehicles: 3 of 6 frames"),
    (["V1/monday", "V2/monday"], "in 2 vehicles: 2 of 4 frames"),
])  # fmt: skip
def test_equal_notices_are_merged_and_their_counts_added(drives: list[str], text: str) -> None:
    notice = Notice(text="{} of {} frames", counts=(1, 2))
    notices = {(vehicle, name): [notice] for vehicle, _, name in (each.partition("/") for each in drives)}
    assert merged_notices(notices) == [text]
