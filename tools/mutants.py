#!/usr/bin/env python3
"""Change the code in many small ways and see that a test fails each time: mutation testing, with mutmut.

Each file of ``tools/mutation`` names modules and the tests that must notice what is changed in them. What survived is
explained in ``docs/mutation.md``. Takes about an hour; what was tried is kept in the folder, and the same command goes
on from there.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrator.terminal.command_line import command_app, run_tool
from ecu_node.documents import write_atomically
from ecu_node.errors import UserError

ROOT = Path(__file__).parents[1]
GROUPS = ROOT / "tools" / "mutation"
MUTMUT = Path(sys.executable).with_name("mutmut")
ISOLATED = ("unshare", "--map-current-user", "--pid", "--fork", "--kill-child", "--mount-proc")
"""How mutmut is run: with process ids of its own, as its time limit may signal ids that were given to others since."""
COPIED = ("ecu_node", "calibrator", "tests", "tools", "dbc", "pyproject.toml")
"""What the tests need of the repository."""
NOTICED = ("killed", "timeout", "segfault")
"""Outcomes in which the tests failed."""
LEAST_KILLED = 0.9
"""Share of the mutants of each group that tests must notice. [1]"""

app = command_app()


class Group(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file of ``tools/mutation``."""

    modules: list[str]
    tests: list[str]
    """The tests that must notice a change."""
    slow: list[str] = []
    """Those of them that are left out: they take too long to be run for each mutant."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of the mutants of one group: status by name."""

    status: dict[str, str]

    @property
    def survivors(self) -> list[str]:
        """Names of the mutants that no test noticed."""
        return [name for name, status in self.status.items() if status not in NOTICED]

    @property
    def shown(self) -> list[str]:
        """Names of those to look at: the survivors, and those that no test ended, which may be for another reason."""
        return [name for name, status in self.status.items() if status != "killed"]

    @property
    def share(self) -> float:
        """Share of the mutants that were noticed."""
        return 1.0 - len(self.survivors) / len(self.status)


@app.command()
def main(
    names: Annotated[list[str] | None, typer.Argument(help="Groups: files of tools/mutation; none: all.")] = None,
    *,
    out: Annotated[Path, typer.Option("--out", help="Folder of the copies that are changed.")] = Path("build/mutation"),
) -> None:
    """Try the mutants, print a table per module and every survivor; exit code 1 if too many of a group survived."""
    known = sorted(path.stem for path in GROUPS.glob("*.toml"))
    unknown = set(names or ()) - set(known)
    if unknown:
        raise UserError(f"{', '.join(sorted(unknown))}: no such group; expected some of {', '.join(known)}")
    if not MUTMUT.exists():
        raise UserError(f"{MUTMUT}: no such program; install mutmut into this environment")
    if shutil.which(ISOLATED[0]) is None or subprocess.run([*ISOLATED, "true"], check=False).returncode != 0:
        raise UserError(f"{' '.join(ISOLATED)}: does not work here; allow user namespaces, or run this as root")
    outcomes = {name: _try(read_group(name), out / name) for name in names or known}
    print("\n".join(_table(outcomes)))
    if any(outcome.share < LEAST_KILLED for outcome in outcomes.values()):
        raise UserError(f"tests noticed less than {LEAST_KILLED:.0%} of the mutants of a group")


def read_group(name: str) -> Group:
    """Read one file of ``tools/mutation``."""
    return msgspec.convert(tomllib.loads((GROUPS / f"{name}.toml").read_text()), Group)


def _try(group: Group, folder: Path) -> Outcome:
    """Run the tests of a group once for each mutant, in a copy of the repository; survivors are tried again."""
    for name in COPIED:
        copy_changed(ROOT / name, folder / name)
    copy_changed(GROUPS / "conftest.py", folder / "conftest.py")
    write_atomically(folder / "setup.cfg", _configuration(group).encode())
    survived = _outcome(folder).survivors if (folder / "mutants").exists() else []
    _run(folder, [])
    outcome = _outcome(folder)
    again = [name for name in survived if name in outcome.survivors]
    if again:
        _run(folder, again)
        outcome = _outcome(folder)
    for name in outcome.shown:
        print(f"\n{_told(folder, 'show', name)}")
    return outcome


def _run(folder: Path, mutants: list[str]) -> None:
    """Try these mutants; all that were not tried yet if none are given."""
    print(f"{folder.name}: see {folder}/progress.txt", file=sys.stderr)
    with (folder / "progress.txt").open("w") as progress:
        done = subprocess.run(
            [*ISOLATED, MUTMUT, "run", "--max-children", "1", *mutants],
            cwd=folder,
            check=False,
            env=os.environ | {"NUMBA_DISABLE_JIT": "1", "OMP_NUM_THREADS": "1"},
            stdout=progress,
            stderr=subprocess.STDOUT,
        )
    if done.returncode != 0:
        raise UserError(f"{folder}: mutmut ended with exit code {done.returncode}; see progress.txt there")


def _outcome(folder: Path) -> Outcome:
    lines = _told(folder, "results", "--all", "true").splitlines()
    return Outcome(status=dict(line.strip().split(": ") for line in lines))


def copy_changed(source: Path, target: Path) -> None:
    """Copy what has changed; a function that is compiled is plain Python in the copy, as mutmut changes no other."""
    if source.is_dir():
        for path in source.iterdir():
            if path.name != "__pycache__":
                copy_changed(path, target / path.name)
        return
    if target.exists() and target.stat().st_mtime == source.stat().st_mtime:
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)
    if source.is_relative_to(ROOT / "calibrator") and source.suffix == ".py":
        target.write_text(re.sub(r"(?m)^@(compiled|compiled_with_notice|inner|inlined)\n", "", source.read_text()))
        shutil.copystat(source, target)


def _configuration(group: Group) -> str:
    entries = {
        "source_paths": group.modules,
        "also_copy": [*COPIED, "conftest.py"],
        "timeout_constant": ["8.0"],  # a loaded machine is slow
        "timeout_multiplier": ["4.0"],
        "do_not_mutate_patterns": [r"^\s*assert "],  # they narrow types
        "pytest_add_cli_args": [
            "-p",
            "no:cacheprovider",
            "-p",
            "no:randomly",
            *(f"--deselect={test}" for test in group.slow),
        ],
        "pytest_add_cli_args_test_selection": group.tests,
    }
    lines = [f"{key} =\n    " + "\n    ".join(values) for key, values in entries.items()]
    return "\n".join(["[mutmut]", *lines, ""])


def _told(folder: Path, *command: str) -> str:
    return subprocess.run([MUTMUT, *command], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def _table(outcomes: dict[str, Outcome]) -> list[str]:
    lines = ["", "| module | mutants | killed | survived |", "|---|---|---|---|"]
    for outcome in outcomes.values():
        tried = Counter(_module(name) for name in outcome.status)
        survived = Counter(_module(name) for name in outcome.survivors)
        lines += [f"| `{name}` | {n} | {n - survived[name]} | {survived[name]} |" for name, n in sorted(tried.items())]
    return lines


def _module(mutant: str) -> str:
    return mutant.rpartition(".")[0]


if __name__ == "__main__":
    run_tool(app, "mutants")
