"""The C export of the project's own layout: how large it is, and how many instructions one frame takes.

    python -m bench.c99

Instructions are counted by valgrind's callgrind inside the function of the message, of this machine's processor; a
frame of a branch that passes through takes none to speak of. Needs gcc, binutils and valgrind.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from random import Random

from rich.console import Console

from bench.all import table_of
from bench.c99_driver import COMPILER, CompiledExport, compile_export
from bench.row import Row
from bench.true_parameters import true_parameters
from calibrator.export.checked import Checked, read_checked
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, write_parameters

__all__ = ["PROGRAMS", "rows"]

PROGRAMS = (COMPILER, "size", "valgrind")
FRAMES = 10_000

_LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"


def main() -> None:
    """Measure and print."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        sys.exit(f"bench.c99: {', '.join(missing)} not found; install gcc, binutils and valgrind")
    Console(width=None if sys.stdout.isatty() else 160).print(table_of(rows(FRAMES)))


def rows(frames: int) -> list[Row]:
    """Measure.

    Parameters
    ----------
    frames : int
        Random frames of the battery's message.

    Returns
    -------
    list of Row
        Code and constants [byte] and instructions per frame, for each of two optimisations.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        return list(_rows(Path(name), frames))


def _rows(folder: Path, frames: int) -> Iterator[Row]:
    checked = _checked(folder)
    for flag in ("-Os", "-O2"):
        export = compile_export(checked, folder, flags=(flag,))
        what = f"C99, five branches, two corrected, {COMPILER} {flag}"
        yield Row(name=f"{what}, size", value=_size(export), unit="byte")
        yield Row(name=f"{what}, per frame", value=_instructions(export, folder, frames) / frames, unit="instructions")


def _checked(folder: Path) -> Checked:
    database = read_database(read_layout(_LAYOUT))
    branches = {
        "battery": BranchParameters(drift=0.02, offset_a=3.0, apply=True),
        "motor": BranchParameters(drift=-0.03, offset_a=1.0, apply=True),
    }
    write_parameters(true_parameters(database, branches), folder / "bench.json")
    return read_checked(folder / "bench.json", database, None)


def _size(export: CompiledExport) -> int:
    """Code and constants. [byte]"""
    text = subprocess.run(["size", export.object_file], capture_output=True, text=True, check=True).stdout
    code, data, unset = map(int, text.splitlines()[1].split()[:3])
    return code + data + unset


def _instructions(export: CompiledExport, folder: Path, frames: int) -> int:
    """All that were executed inside the function of the battery's message."""
    rng, out = Random(0), folder / "callgrind.out"  # noqa: S311
    command = [
        "valgrind",
        "--tool=callgrind",
        "--collect-atstart=no",
        "--toggle-collect=hv_rewrite_HV_Battery",
        f"--callgrind-out-file={out}",
        "--quiet",
        str(export.executable),
    ]
    given = export.encode([("HV_Battery", rng.randbytes(8)) for _ in range(frames)])
    subprocess.run(command, input=given, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
    (total,) = re.findall(r"^(?:summary|totals): (\d+)", out.read_text(), flags=re.MULTILINE)[:1]
    return int(total)


if __name__ == "__main__":
    main()
