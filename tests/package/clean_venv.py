"""Clean environments: the built wheel, its pinned dependencies, and nothing else."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
_PIN = re.compile(r"(?m)^(\S+==\S+(?: ; [^\\\n]+)?)")
"""A pin of a constraints file without its hashes: with them pip would want one of the built wheel, too."""


@dataclass(frozen=True, kw_only=True)
class CleanVenv:
    """A virtual environment in which no file of the checkout is seen.

    Attributes
    ----------
    folder : Path
        Where it is.
    environment : dict of str
        Variables of the processes that run in it.
    """

    folder: Path
    environment: dict[str, str]

    def program(self, name: str) -> str:
        """Path of a program in it."""
        return str(self.folder / "bin" / name)

    def run(
        self, name: str, *arguments: object, folder: Path, timeout_s: float = 900.0
    ) -> "subprocess.CompletedProcess[str]":
        """Run a program in it to its end.

        Parameters
        ----------
        name : str
            Of the program.
        *arguments
            Its arguments.
        folder : Path
            Its working folder.
        timeout_s : float
            It is killed after this. [s]

        Returns
        -------
        CompletedProcess
            With what it printed.
        """
        command, environment = [self.program(name), *map(str, arguments)], self.environment
        return subprocess.run(
            command,
            cwd=folder,
            env=environment,
            input="",
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout_s,
        )

    def install(self, *what: str) -> None:
        """Install distributions, pinned by constraints.txt, or end the program with what pip says."""
        known = self.folder / "pins.txt"
        known.write_text("\n".join(pin.strip() for pin in _PIN.findall((ROOT / "constraints.txt").read_text())))
        _pip(self, "install", "--no-compile", "--constraint", str(known), *what)


def new_venv(folder: Path, wheel: Path, *extras: str, interpreter: str = sys.executable) -> CleanVenv:
    """Make a clean environment.

    Parameters
    ----------
    folder : Path
        To be made.
    wheel : Path
        The built wheel.
    *extras : str
        What to install with it.
    interpreter : str
        The Python it is made of.

    Returns
    -------
    CleanVenv
        With pip, but without setuptools where nothing says that it needs it.

    Raises
    ------
    SystemExit
        If the interpreter or pip fails.
    """
    made = subprocess.run([interpreter, "-m", "venv", str(folder)], capture_output=True, text=True, check=False)
    if made.returncode:
        raise SystemExit(f"{interpreter}: cannot make an environment: {made.stderr.strip() or made.stdout.strip()}")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    venv = CleanVenv(folder=folder, environment={**environment, "CALIBRATOR_CACHE": str(folder.parent / "cache")})
    _pip(venv, "uninstall", "--yes", "setuptools")
    venv.install(f"{wheel}[{','.join(extras)}]" if extras else str(wheel))
    return venv


def _pip(venv: CleanVenv, *arguments: str) -> None:
    options = ("--quiet", "--disable-pip-version-check", "--no-input")
    done = venv.run("python", "-m", "pip", *arguments, *options, folder=venv.folder)
    if done.returncode:
        raise SystemExit(f"pip {' '.join(arguments)}: {done.stderr.strip()}")
