"""Groups of mutants: they name what is there, and the copy that is changed runs without compilation."""

import subprocess
import sys
from pathlib import Path

import pytest

import mutants

GROUPS = sorted(path.stem for path in mutants.GROUPS.glob("*.toml"))


@pytest.mark.parametrize("name", GROUPS)
def test_a_group_names_modules_and_tests_that_are_there(name: str) -> None:
    group = mutants.read_group(name)
    assert all((mutants.ROOT / module).is_file() for module in group.modules)
    assert all((mutants.ROOT / test).is_file() for test in group.tests)
    for test in group.slow:
        path, _, function = test.partition("::")
        assert path in group.tests
        assert f"def {function}(" in (mutants.ROOT / path).read_text()


def test_no_module_is_in_two_groups() -> None:
    modules = [module for name in GROUPS for module in mutants.read_group(name).modules]
    assert len(set(modules)) == len(modules)


def test_functions_that_are_compiled_are_plain_python_in_the_copy(tmp_path: Path) -> None:
    source = mutants.ROOT / "calibrator" / "estimator" / "posterior.py"
    mutants.copy_changed(source, tmp_path / "posterior.py")
    assert "\n@inner\ndef " in source.read_text()
    assert "\n@cache\ndef " in (tmp_path / "posterior.py").read_text()
    assert "\n@inner\n" not in (tmp_path / "posterior.py").read_text()


def test_a_group_that_is_not_there_is_named_with_those_that_are() -> None:
    done = subprocess.run(
        [sys.executable, mutants.__file__, "nothing"], cwd=mutants.ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "nothing: no such group; expected some of correction, " in done.stderr
