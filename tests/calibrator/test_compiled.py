"""Compiled code is kept in a folder that real processes share, change, break, and find closed."""

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

LINE = "compiling the estimator"
SCRIPT = textwrap.dedent("""
    import numpy as np
    from calibrator.compiled import compiled_with_notice, inlined, inner

    @inner
    def square(x):
        return x * x

    @inlined
    def plus_one(x):
        return x + 1.0

    @compiled_with_notice
    def sum_of_squares(values, out):
        out[0] = 0.0
        for value in values:
            out[0] += plus_one(square(value)) - 1.0

    out = np.zeros(1)
    sum_of_squares(np.array([1.0, 2.0, 3.0]), out)
    print(out[0])
""")


def installed(folder: Path) -> Path:
    """A copy of what is compiled, which a test may change; and a script that compiles a function of its own."""
    source = Path(calibrator.__file__).parent
    for name in ("__init__.py", "compiled.py", "score.py", "estimator/prior.py"):
        (folder / "calibrator" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / name, folder / "calibrator" / name)
    (folder / "script.py").write_text(SCRIPT, encoding="utf-8")
    return folder


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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return installed(tmp_path / "installed")


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def test_code_is_compiled_once_and_the_user_is_told(folder: Path, cache: Path) -> None:
    first = said(started(folder, cache))
    assert first.count(LINE) == 1
    assert first.count("\n") == 1
    assert said(started(folder, cache)) == ""


@pytest.mark.long
def test_of_two_processes_at_once_one_compiles(folder: Path, cache: Path) -> None:
    both = [started(folder, cache) for _ in range(2)]
    assert sorted(said(process).count(LINE) for process in both) == [0, 1]


@pytest.mark.long
def test_a_changed_source_is_compiled_anew(folder: Path, cache: Path) -> None:
    said(started(folder, cache))
    with (folder / "calibrator" / "estimator" / "prior.py").open("a", encoding="utf-8") as source:
        source.write("# changed\n")
    assert LINE in said(started(folder, cache))
    assert len(list(cache.glob("compiled-*"))) == 2


def test_every_file_with_compiled_functions_is_among_those_whose_change_is_noticed() -> None:
    package = Path(calibrator.__file__).parent
    found = {pattern: set(package.glob(pattern)) for pattern in SOURCES}
    assert [pattern for pattern, paths in found.items() if not paths] == []
    users = {path for path in package.rglob("*.py") if "from calibrator.compiled import" in path.read_text("utf-8")}
    assert len(users) > 5
    assert users - set().union(*found.values()) == set()


@pytest.mark.long
@pytest.mark.parametrize(("variable", "other"), [("NUMBA_CPU_NAME", "generic"), ("NUMBA_CPU_FEATURES", "+sse2")])
def test_another_processor_has_code_of_its_own(folder: Path, cache: Path, variable: str, other: str) -> None:
    said(started(folder, cache))
    assert LINE in said(started(folder, cache, **{variable: other}))
    assert len(list(cache.glob("compiled-*"))) == 2


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


@pytest.mark.long
def test_without_a_folder_that_can_be_written_every_run_compiles_and_says_why(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for _ in range(2):
        error = said(started(folder, tmp_path / "file" / "below"))
        assert error.count("\n") == 1
        assert "in every run, as its cache cannot be written; CALIBRATOR_CACHE can name another folder" in error


def test_a_home_that_cannot_be_written_is_no_obstacle(folder: Path) -> None:
    assert "in every run" in said(started(folder, "", HOME="/proc", XDG_CACHE_HOME=""))


def test_old_code_goes_and_foreign_files_stay(folder: Path, cache: Path) -> None:
    for age in range(6):
        old = cache / f"compiled-{age:016d}"
        old.mkdir(parents=True)
        os.utime(old, (1e9 - age, 1e9 - age))
    (cache / "mine").mkdir()
    said(started(folder, cache))
    kept = sorted(path.name for path in cache.iterdir())
    assert kept[:3] == [f"compiled-{age:016d}" for age in range(3)]
    assert len(kept) == 5
    assert kept[-1] == "mine"


@compiled
def doubled(values: Array) -> Array:
    return 2.0 * values


def test_a_compiled_function_may_make_arrays_where_it_is_not_compiled_with_notice() -> None:
    np.testing.assert_array_equal(doubled(np.arange(3.0)), [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(doubled(np.ones((2, 2))), 2.0 * np.ones((2, 2)))
