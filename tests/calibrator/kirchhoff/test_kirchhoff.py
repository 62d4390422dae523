import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from calibrator.drive import Array, Channel, Drive
from calibrator.errors import DriveError
from calibrator.kirchhoff.sums import Comparison, compare_kirchhoff, figures_of
from calibrator.kirchhoff.view import kirchhoff_table, plot_kirchhoff
from calibrator.recordings.readers import Recording, RecordingReport
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout

TIME_S = np.arange(0.0, 20.0, 0.05)
REPORT = RecordingReport(channels=(), frames=0, error_frames=0, remote_frames=0, damaged=0, disordered=0, clock_steps=0)


@pytest.fixture
def layout(database: VehicleDatabase) -> Layout:
    return database.layout


def channel(value: Array) -> Channel:
    return Channel(time_s=TIME_S, value=value, good=np.isfinite(value))


def recording(measured: dict[str, Array], corrected: dict[str, Array] | None = None) -> Recording:
    drive = Drive(vehicle="V1", name="d", branches={k: channel(v) for k, v in measured.items()}, inputs={})
    return Recording(drive=drive, corrected={k: channel(v) for k, v in (corrected or {}).items()}, report=REPORT)


def faulty(drift: float, offset_a: float) -> tuple[dict[str, Array], dict[str, Array]]:
    true = {"battery": 100.0 * np.sin(TIME_S), "motor": -100.0 * np.sin(TIME_S)}
    return true | {"battery": (1.0 + drift) * true["battery"] + offset_a}, true


def test_figures_of_a_known_current() -> None:
    figures = figures_of(np.array([3.0, -5.0, 5.0, 1.0]))
    assert figures.rmse_a == pytest.approx(15.0**0.5)
    assert (figures.max_a, figures.mean_a) == (5.0, 1.0)
    assert figures.rmse_a**2 == pytest.approx(figures.mean_a**2 + figures.sd_a**2)
    assert figures.as_json(200.0)["rmse_percent"] == pytest.approx(figures.rmse_a / 2.0)


def test_an_offset_is_the_mean_of_the_sum_before_and_gone_after(layout: Layout) -> None:
    measured, true = faulty(0.0, 12.0)
    comparison = compare_kirchhoff(recording(measured, true), layout)
    assert comparison.before["sum"].rmse_a == pytest.approx(12.0)
    assert comparison.after is not None
    assert comparison.change is not None
    assert comparison.after["sum"].rmse_a == pytest.approx(0.0, abs=1e-12)
    assert comparison.change["battery"].mean_a == pytest.approx(-12.0)
    assert comparison.change["motor"].max_a == 0.0


def test_doubling_all_currents_doubles_all_figures(layout: Layout) -> None:
    measured, _ = faulty(0.1, 3.0)
    one = compare_kirchhoff(recording(measured), layout).before
    two = compare_kirchhoff(recording({k: 2.0 * v for k, v in measured.items()}), layout).before
    for name, figures in one.items():
        np.testing.assert_allclose(list(vars(two[name]).values()), 2.0 * np.array(list(vars(figures).values())))


def test_without_corrected_frames_there_is_only_a_before(layout: Layout) -> None:
    comparison = compare_kirchhoff(recording(faulty(0.1, 0.0)[0]), layout)
    assert comparison.after is None
    assert comparison.change is None
    assert "no corrected frames: only the figures before" in comparison.notices()


def test_absent_branches_are_named_and_left_out_of_the_sum(layout: Layout) -> None:
    comparison = compare_kirchhoff(recording(faulty(0.1, 0.0)[0]), layout)
    assert comparison.branches == ("battery", "motor")
    assert comparison.notices()[0] == "no usable frames of auxiliary, dcdc, motor_rear: left out of the sum"


def test_a_branch_without_corrected_frames_enters_the_sum_after_as_measured(layout: Layout) -> None:
    measured, true = faulty(0.0, 12.0)
    comparison = compare_kirchhoff(recording(measured, {"battery": true["battery"]}), layout)
    assert comparison.uncorrected == ("motor",)
    assert comparison.after is not None
    assert comparison.after["motor"] == comparison.before["motor"]
    assert comparison.after["sum"].rmse_a == pytest.approx(0.0, abs=1e-12)


def test_corrected_frames_without_measured_ones_are_not_used(layout: Layout) -> None:
    measured, true = faulty(0.0, 12.0)
    comparison = compare_kirchhoff(recording(measured, {"dcdc": true["motor"]}), layout)
    assert comparison.after is None


def test_instants_that_are_not_good_are_counted_and_not_used(layout: Layout) -> None:
    measured, _ = faulty(0.0, 12.0)
    measured["battery"][100:110] = np.nan
    comparison = compare_kirchhoff(recording(measured), layout)
    assert comparison.before["sum"].rmse_a == pytest.approx(12.0)
    assert comparison.masked["not good"] == 5
    assert comparison.notices()[-1] == "5 of 200 instants not used: 5 not good"


def test_one_branch_alone_has_no_sum(layout: Layout) -> None:
    with pytest.raises(DriveError, match="usable frames of battery only; a sum needs two branches"):
        compare_kirchhoff(recording({"battery": np.sin(TIME_S)}), layout)


def test_branches_that_are_never_fresh_together_are_refused(layout: Layout) -> None:
    sparse = Channel(time_s=np.array([0.03, 18.03]), value=np.zeros(2), good=np.ones(2, np.bool_))
    broken = recording(faulty(0.0, 1.0)[0])
    drive = Drive(vehicle="V1", name="d", branches={**broken.drive.branches, "motor": sparse}, inputs={})
    with pytest.raises(DriveError, match="no instant at which all of battery, motor are fresh"):
        compare_kirchhoff(Recording(drive=drive, corrected={}, report=REPORT), layout)


def printed(comparison: Comparison) -> list[str]:
    output = io.StringIO()
    Console(width=80, file=output).print(kirchhoff_table(comparison))
    return output.getvalue().splitlines()


def test_the_table_fits_80_columns_with_the_longest_names_and_largest_figures(layout: Layout) -> None:
    measured = {name: -1000.0 + np.sin(TIME_S) for name in layout.branch_names}
    lines = printed(compare_kirchhoff(recording(measured, measured), layout))
    assert all(len(line) <= 80 for line in lines)
    assert sum("motor_rear" in line and "-999.97" in line for line in lines) == 2
    assert [line.strip() for line in lines if line.strip() in {"before", "after", "change"}] == [
        "before",
        "after",
        "change",
    ]


def test_a_name_that_has_no_room_is_broken_and_no_figure_is_cut(layout: Layout) -> None:
    measured, corrected = faulty(0.1, 2.0)
    comparison = compare_kirchhoff(recording(measured, corrected), layout)
    long = "x" * 64
    lines = printed(replace(comparison, branches=(long, *comparison.branches[1:])))
    assert "…" not in "".join(lines)
    assert sum(line.count("x") for line in lines if "max" not in line) == 3 * len(long)  # before, after, change
    assert max(map(len, lines)) <= 80


def test_the_picture_is_written_with_one_panel_or_two(layout: Layout, tmp_path: Path) -> None:
    measured, true = faulty(0.05, 12.0)
    for name, corrected in (("one.png", None), ("two.png", true)):
        plot_kirchhoff(compare_kirchhoff(recording(measured, corrected), layout), tmp_path / name, title="drive")
    heights = [int.from_bytes((tmp_path / name).read_bytes()[20:24]) for name in ("one.png", "two.png")]
    assert heights[0] < heights[1]


def test_a_picture_that_cannot_be_written_is_named(layout: Layout, tmp_path: Path) -> None:
    comparison = compare_kirchhoff(recording(faulty(0.05, 12.0)[0]), layout)
    for path in (tmp_path / "nowhere" / "x.png", tmp_path / "x.what"):
        with pytest.raises(DriveError, match="cannot write the picture"):
            plot_kirchhoff(comparison, path, title="drive")
