"""What the node alone puts on a vehicle's computer: packages, their size on disk, and how long its start takes.

    cd tools && python -m release.measure_install [../dist]

Ends with 1 if the import takes longer than a quarter of a second.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from statistics import median

from release.clean_venv import ROOT, CleanVenv, new_venv, the_wheel

__all__ = ["import_times_s", "main", "sizes_mb"]

LONGEST_IMPORT_S = 0.25
RUNS = 11
_SIZES = """
import json
from importlib.metadata import distributions
from importlib.util import cache_from_source
from pathlib import Path
def size(one):
    files = [str(file.locate()) for file in one.files]
    files += [cache_from_source(file) for file in files if file.endswith(".py")]
    return sum(Path(file).stat().st_size for file in files if Path(file).is_file())
found = [one for one in distributions() if one.metadata["Name"] != "pip"]
print(json.dumps({f"{one.metadata['Name']} {one.version}": size(one) for one in found}))
"""
_IMPORT = "import time; t = time.perf_counter(); import ecu_node.cli; print(time.perf_counter() - t)"


def sizes_mb(venv: CleanVenv) -> dict[str, float]:
    """Size of every distribution in an environment but pip, with its compiled files. [MB]"""
    done = venv.run("python", "-c", _SIZES, folder=venv.folder)
    return {name: size / 1e6 for name, size in sorted(json.loads(done.stdout).items())}


def import_times_s(venv: CleanVenv) -> list[float]:
    """How long the import of the node's command line takes, in new processes, after a first one. [s]"""
    return [float(venv.run("python", "-c", _IMPORT, folder=venv.folder).stdout) for _ in range(RUNS + 1)][1:]


def main() -> int:
    """Measure and print; exit code 1 if the import takes too long."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("dist", type=Path, nargs="?", default=ROOT / "dist", help="folder of the built wheel")
    wheel = the_wheel(parser.parse_args().dist)
    with tempfile.TemporaryDirectory() as folder:
        venv = new_venv(Path(folder) / "node", wheel)
        venv.run("python", "-m", "compileall", "-q", venv.folder, folder=venv.folder)
        sizes, times_s = sizes_mb(venv), import_times_s(venv)
    for name, size_mb in sizes.items():
        print(f"{size_mb:8.2f} MB  {name}")
    print(f"{sum(sizes.values()):8.2f} MB  {len(sizes)} packages")
    seconds = median(times_s)
    print(f"{seconds:8.3f} s   import of ecu_node.cli (median of {RUNS}, {min(times_s):.3f} to {max(times_s):.3f})")
    if seconds >= LONGEST_IMPORT_S:
        print(f"measure_install: the import may take {LONGEST_IMPORT_S} s", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
