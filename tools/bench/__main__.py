"""Benchmarks, each with its peer in the same run; the table is also written as JSON.

python -m bench [GROUP] [--quick]        (in tools/)
"""

import argparse
import json
import sys
from importlib import import_module
from pathlib import Path

from bench.row import Row, show

GROUPS = ("posterior", "ingest", "fleet_run", "node", "fleet_report", "on_board", "cluster")
"""Modules of this folder with a function ``rows``."""
OUT = Path("build") / "bench.json"


def main() -> None:
    """Measure, write as far as rows have come, and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("group", nargs="?", choices=GROUPS, help="one group; all of them without it")
    parser.add_argument("--quick", action="store_true", help="small sizes, within five minutes: shows that all works")
    parser.add_argument("--out", type=Path, default=OUT, help=f"JSON file; {OUT} without it")
    arguments = parser.parse_args()
    found: list[Row] = []
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    for name in [arguments.group] if arguments.group else GROUPS:
        print(f"bench: {name}", file=sys.stderr, flush=True)
        found += import_module(f"bench.{name}").rows(quick=arguments.quick)
        arguments.out.write_text(json.dumps([vars(row) for row in found], indent=2) + "\n")
    show(found)


if __name__ == "__main__":
    main()
