"""A figure holds as long as the files that it was measured with say the same, those that they import included."""

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

import release_check
from acceptance.inputs import digest, files_that_run
from acceptance.steps import BENCHES, PYTHON, Step, steps
from bench.all import GROUPS
from ecu_node.errors import UserError

ROOT = Path(__file__).parents[2]
FILES = {
    "constraints.txt": "numpy==2.0\n",
    "tools/measure.py": "import numpy\n\n\ndef main():\n    from calibrator.fit import solve\n",
    "calibrator/__init__.py": "",
    "calibrator/fit.py": "from calibrator import rows, drive\n",
    "calibrator/rows.py": "from ecu_node.core.signals import Code\n",
    "calibrator/drive.py": "",
    "calibrator/report.py": "",
    "ecu_node/core/signals.py": "",
    "dbc/car.dbc": 'VERSION ""\n',
}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    subprocess.run(["git", "init", "--quiet"], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "--all"], cwd=tmp_path, check=True)
    return tmp_path


def test_what_a_script_imports_counts_within_functions_and_through_modules(checkout: Path) -> None:
    found = {str(path.relative_to(checkout)) for path in files_that_run(checkout, ["tools/measure.py", "dbc"])}
    assert found == FILES.keys() - {"constraints.txt", "calibrator/report.py"}


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ("ecu_node/core/signals.py", False),
        ("dbc/car.dbc", False),
        ("constraints.txt", False),
        ("calibrator/report.py", True),
        ("calibrator/new.py", True),
    ],
)
def test_figures_hold_until_something_that_they_are_made_with_changes(changed: str, same: bool, checkout: Path) -> None:
    before = digest(checkout, ["tools/measure.py", "dbc"])
    (checkout / changed).write_text("# another\n")
    assert (digest(checkout, ["tools/measure.py", "dbc"]) == before) is same


def test_an_entry_that_is_not_there_is_named(checkout: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing: nothing of it is committed"):
        files_that_run(checkout, ["nothing"])


def test_a_step_is_run_again_until_it_ends_well_and_when_it_changes(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(release_check, "ROOT", checkout)
    out = checkout / "out"
    out.mkdir()
    code = "from pathlib import Path; print('ran'); Path('out/count.json').open('a').write('x'); "
    good = Step(name="count", command=(PYTHON, "-c", code), runs=("dbc",))
    bad = replace(good, command=(PYTHON, "-c", f"{code} raise SystemExit(1)"))
    for step, runs in ((bad, 1), (bad, 2), (good, 3), (good, 3), (replace(good, name="other", feeds=("count",)), 4)):
        release_check.run_step(step, out, "c0ffee")
        assert (out / "count.json").read_text() == runs * "x", "what a step measures is its own"
    assert (out / "count.txt").read_text() == "ran\n"
    assert not release_check.holds(good, out), "what fed it was run again"
    release_check.run_step(good, out, "c0ffee")
    assert release_check.holds(good, out)
    (checkout / "dbc" / "car.dbc").write_text("another")
    assert not release_check.holds(good, out)


def test_of_each_step_it_is_told_how_long_it_took_and_at_which_commit(tmp_path: Path) -> None:
    step = Step(name="node fuzz 31", command=("true",), runs=("dbc",))
    (tmp_path / "node_fuzz_31.step.json").write_text('{"commit": "c0ffee0123456789", "minutes": 40.917}')
    rows = release_check.steps_table([step], tmp_path).splitlines()
    assert rows[-1] == "| node fuzz 31 | 40.9 | c0ffee012345 |"


def test_files_that_change_under_a_step_are_told(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release_check, "ROOT", checkout)
    step = Step(name="edit", command=("sh", "-c", "echo another > dbc/car.dbc"), runs=("dbc",))
    with pytest.raises(UserError, match="files of step 'edit' changed while it ran"):
        release_check.run_step(step, checkout, "c0ffee")
    assert not release_check.holds(step, checkout)


def test_every_step_names_files_of_this_checkout() -> None:
    wanted = list(steps(Path("build/release"), Path("trips")))
    assert len({step.name for step in wanted}) == len(wanted)
    files = {step.name: {path.relative_to(ROOT) for path in files_that_run(ROOT, step.runs)} for step in wanted}
    assert all(any(path.parts[0] in {"calibrator", "ecu_node"} for path in found) for found in files.values())
    assert Path("calibrator/estimator/decision.py") in files["experiment real"]
    assert Path("calibrator/report/page.py") not in files["experiment real"]
    assert Path("tests/tools/test_release_inputs.py") in files["tests"]


def test_every_group_of_benchmarks_is_a_step() -> None:
    assert list(BENCHES) == list(GROUPS)
