"""Compiled code is kept in a folder that real processes share, change, break, and find closed."""

import ast
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import calibrator
from calibrator.compiled import SOURCES, compiled
from calibrator.drive import Array

ROOT = Path(calibrator.__file__).parents[1]
LINE = "compiling the estimator"
SCRIPT = textwrap.dedent("""
    import numpy as np
    from calibrator.compiled import compiled_with_notice, inner

    @inner
    def square(x):
        return x * x

    @compiled_with_notice
    def sum_of_squares(values, out):
        out[0] = 0.0
        for value in values:
            out[0] += square(value)

    out = np.zeros(1)
    sum_of_squares(np.array([1.0, 2.0, 3.0]), out)
    print(out[0])
""")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the product, which a test may change; and a script that compiles a function of its own."""
    for package in ("calibrator", "ecu_node"):
        shutil.copytree(ROOT / package, tmp_path / "installed" / package)
    (tmp_path / "installed" / "script.py").write_text(SCRIPT, encoding="utf-8")
    return tmp_path / "installed"


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def started(folder: Path, cache: Path | str, **environment: str) -> subprocess.Popen[str]:
    variables = {**os.environ, "CALIBRATOR_CACHE": str(cache), "PYTHONPATH": str(folder), **environment}
    return subprocess.Popen(
        [sys.executable, "script.py"],
        cwd=folder,
        env={name: value for name, value in variables.items() if value},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def said(process: subprocess.Popen[str]) -> str:
    """What a process that gives the right result wrote to stderr."""
    out, error = process.communicate()
    assert (process.returncode, out.strip()) == (0, "14.0"), error
    return error


def test_code_is_compiled_once_with_one_line_and_old_code_goes(folder: Path, cache: Path) -> None:
    for age in range(6):
        old = cache / f"compiled-{age:016d}"
        old.mkdir(parents=True)
        os.utime(old, (1e9 - age, 1e9 - age))
    (cache / "mine").mkdir()
    first = said(started(folder, cache))
    assert (first.count(LINE), first.count("\n")) == (1, 1)
    kept = sorted(path.name for path in cache.iterdir())
    assert kept[:3] == [f"compiled-{age:016d}" for age in range(3)]
    assert (len(kept), kept[-1]) == (5, "mine")
    assert said(started(folder, cache)) == ""


@pytest.mark.long
def test_of_two_processes_at_once_one_compiles(folder: Path, cache: Path) -> None:
    both = [started(folder, cache) for _ in range(2)]
    assert sorted(said(process).count(LINE) for process in both) == [0, 1]


@pytest.mark.long
@pytest.mark.parametrize(
    "changed",
    [{}, {"NUMBA_CPU_NAME": "generic"}, {"NUMBA_CPU_FEATURES": "+sse2"}],
    ids=["source", "processor", "its features"],
)
def test_another_source_or_processor_has_code_of_its_own(folder: Path, cache: Path, changed: dict[str, str]) -> None:
    said(started(folder, cache))
    if not changed:
        with (folder / "calibrator" / "estimator" / "prior.py").open("a", encoding="utf-8") as source:
            source.write("# changed\n")
    assert LINE in said(started(folder, cache, **changed))
    assert len(list(cache.glob("compiled-*"))) == 2


def test_every_file_with_compiled_functions_or_their_constants_is_among_those_whose_change_is_noticed() -> None:
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


@pytest.mark.long
@pytest.mark.parametrize(("files", "content"), [("*.nbi", b""), ("*.nbc", b"\0" * 64)])
def test_code_that_cannot_be_read_is_compiled_anew(folder: Path, cache: Path, files: str, content: bytes) -> None:
    said(started(folder, cache))
    for broken in cache.rglob(files):
        broken.write_bytes(content)
    said(started(folder, cache))  # works, and throws away what it could not read
    said(started(folder, cache))
    assert said(started(folder, cache)) == ""
    assert all(kept.stat().st_size > len(content) for kept in cache.rglob(files))


def test_without_a_folder_that_can_be_written_every_run_compiles_and_says_why(folder: Path) -> None:
    error = said(started(folder, "", HOME="/proc", XDG_CACHE_HOME=""))
    assert error.count("\n") == 1
    assert "in every run, as its cache cannot be written; CALIBRATOR_CACHE can name another folder" in error


@compiled
def doubled(values: Array) -> Array:
    return 2.0 * values


def test_a_compiled_function_may_make_arrays_where_it_is_not_compiled_with_notice() -> None:
    np.testing.assert_array_equal(doubled(np.arange(3.0)), [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(doubled(np.ones((2, 2))), 2.0 * np.ones((2, 2)))
