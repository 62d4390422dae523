"""All benchmarks: one table, and the same as ``build/bench.json``."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench import fleet_report, fleet_run, identification, ingest, node, posterior
from bench.row import Row

GROUPS: dict[str, Callable[..., list[Row]]] = {
    "identification": identification.rows,
    "posterior": posterior.rows,
    "ingest": ingest.rows,
    "fleet run": fleet_run.rows,
    "node": node.rows,
    "fleet report": fleet_report.rows,
}
OUT = Path("build") / "bench.json"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, within five minutes: shows that all works")
    parser.add_argument("--out", type=Path, default=OUT, help=f"JSON file; {OUT} without it")
    parser.add_argument("--only", choices=list(GROUPS), help="one group")
    arguments = parser.parse_args()
    found: list[Row] = []
    for name, rows in GROUPS.items():
        if arguments.only in {None, name}:
            print(f"bench: {name}", file=sys.stderr, flush=True)
            found += rows(quick=arguments.quick)
            write(found, arguments.out)
    Console(width=None if sys.stdout.isatty() else 160).print(table_of(found))


def write(rows: list[Row], path: Path) -> None:
    """Write rows as JSON, so far as they have come."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([vars(row) for row in rows], indent=2) + "\n")


def table_of(rows: list[Row]) -> Table:
    """Rows as a table."""
    table = Table("what", "figure", "unit", "peer", "times better")
    for row in rows:
        table.add_row(
            row.name,
            f"{row.value:.4g}",
            row.unit,
            row.peer or "",
            "" if row.ratio is None else f"{row.ratio:.3g}",
        )
    return table


if __name__ == "__main__":
    main()
