"""Benchmarks, many beside a peer (another way to do the same) in the same run; the table is also written as JSON.

python -m bench [GROUP] [--quick]        (in tools/)
"""

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from bench.row import Row, show
from calibrator.experiments.runner import made_now

Group = Literal[
    "posterior", "ingest", "fleet_run", "node", "fleet_report", "on_board", "repository", "trust_chain", "cluster"
]
"""Modules of this folder with a function ``rows``."""
OUT = Path(__file__).parents[2] / "build" / "bench.json"


def main(group: Annotated[Group | None, typer.Argument()] = None, *, quick: bool = False, out: Path = OUT) -> None:
    """Measure one group, or all of them; --quick takes small sizes and five minutes, to show that all works."""
    found, made = list[Row](), made_now()
    out.parent.mkdir(parents=True, exist_ok=True)
    for name in [group] if group is not None else get_args(Group):
        print(f"bench: {name}", file=sys.stderr, flush=True)
        found += import_module(f"bench.{name}").rows(quick=quick)
        rows = [vars(row) | {"made": made} for row in found]  # so far
        out.write_text(json.dumps(rows, indent=2) + "\n")
    show(found)


if __name__ == "__main__":
    typer.run(main)
