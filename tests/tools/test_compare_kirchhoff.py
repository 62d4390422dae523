import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
MISSING = ("--layout", "none.toml", "none.log")


def run(*command: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False, cwd=ROOT)


def test_the_script_is_the_command() -> None:
    script, command = run("tools/compare_kirchhoff.py", *MISSING), run("-m", "calibrator", "kirchhoff", *MISSING)
    assert (script.returncode, script.stdout, script.stderr) == (1, "", command.stderr)
    cause = "cannot read the layout: No such file or directory; name the layout (TOML) of this vehicle"
    assert script.stderr == f"calibrator: none.toml: {cause}\n"
    assert run("tools/compare_kirchhoff.py").returncode == 2
