"""Compiled code is cached in a folder for this version of the source, and works without one."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import calibrator
from calibrator.compiled import SOURCES, compiled, inner, is_compiled  # noqa: F401 (by the program)
from calibrator.drive import Array

ROOT = Path(calibrator.__file__).parents[1]


@inner
def doubled(value: float) -> float:
    return 2.0 * value


@compiled
def largest(values: Array) -> float:
    found = doubled(values[0])
    for value in values[1:]:
        found = max(found, doubled(value))
    return found


@pytest.mark.parametrize("writable", [True, False])
def test_compiled_code_is_cached_if_the_folder_is_writable(tmp_path: Path, writable: bool) -> None:
    (tmp_path / "file").touch()
    cache = tmp_path / "cache" if writable else tmp_path / "file" / "cache"
    found = "is_compiled('test_compiled'), largest(np.array([1.0, 3.0, 2.0])), is_compiled('test_compiled')"
    program = f"from tests.calibrator.test_compiled import is_compiled, largest, np; print({found})"
    variables = {**os.environ, "CALIBRATOR_CACHE": str(cache)}
    printed = subprocess.check_output([sys.executable, "-c", program], cwd=ROOT, env=variables, text=True)
    assert printed == f"False 6.0 {writable}\n"
    assert any(cache.rglob("*.nbc")) == writable


def test_sources_that_invalidate_the_cache_include_all_that_compiled_functions_use() -> None:
    needed = set[str]()
    for path in (ROOT / "calibrator").rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        imports = [item for item in tree.body if isinstance(item, ast.ImportFrom) and item.module]
        origin = {alias.name: f"{str(item.module).replace('.', '/')}.py" for item in imports for alias in item.names}
        marks = {name for name, source in origin.items() if source == "calibrator/compiled.py"}
        for item in tree.body:
            if isinstance(item, ast.FunctionDef) and any(ast.unparse(mark) in marks for mark in item.decorator_list):
                names = {part.id for line in item.body for part in ast.walk(line) if isinstance(part, ast.Name)}
                needed |= {path.relative_to(ROOT).as_posix(), *(origin[name] for name in names & origin.keys())}
    own = {name for name in needed if name.startswith(("calibrator/", "ecu_node/"))}
    assert len(own) > 5
    assert own - set(SOURCES) == set()


def test_compiled_division_by_zero_gives_infinity_as_in_numpy() -> None:
    @compiled
    def inverse(value: float) -> float:
        return 1.0 / value

    assert inverse(0.0) == np.inf
