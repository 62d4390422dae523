"""All benchmarks: one table, and the same as ``build/bench.json``."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

from bench import fleet_report, fleet_run, ingest, node, posterior
from bench.row import Row, show

GROUPS: dict[str, Callable[..., list[Row]]] = {
    "posterior": posterior.rows,
    "ingest": ingest.rows,
    "fleet run": fleet_run.rows,
    "node": node.rows,
    "fleet report": fleet_report.rows,
}
OUT = Path("build") / "bench.json"


def main() -> None:
    """Measure, write as far as rows have come, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, within five minutes: shows that all works")
    parser.add_argument("--out", type=Path, default=OUT, help=f"JSON file; {OUT} without it")
    parser.add_argument("--only", choices=list(GROUPS), help="one group")
    arguments = parser.parse_args()
    found: list[Row] = []
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    for name, rows in GROUPS.items():
        if arguments.only in {None, name}:
            print(f"bench: {name}", file=sys.stderr, flush=True)
            found += rows(quick=arguments.quick)
            arguments.out.write_text(json.dumps([vars(row) for row in found], indent=2) + "\n")
    show(found)


if __name__ == "__main__":
    main()
