#!/usr/bin/env python3
"""Print the table of docs/layout_init.md: what 'calibrator layout init' finds in the CAN databases of a folder.

    tools/tried_databases.py FOLDER [--right right.csv]

Prints one line of Markdown per database, and how often each result came: right, wrong, none, refused, not known. The
table --right has the columns ``database`` (file without suffix) and ``battery`` (``Message.Signal``, empty where its
authors name none); for a database that is not in it, only what was found is shown. A file NAME.log, .csv, ... beside
NAME.dbc is its log.
"""

import argparse
import csv
from collections import Counter
from pathlib import Path

from calibrator.proposal.proposal import look_at
from ecu_node.errors import UserError

DATABASES = (".dbc", ".kcd", ".sym", ".arxml")


def found_in(database: Path) -> tuple[str, str]:
    """Return the signal proposed as battery current, and the problem or the other branches, as texts.

    The signal is "" if none is proposed, and "refused" if the database cannot be used.
    """
    logs = [path for path in sorted(database.parent.glob(f"{database.stem}.*")) if path.suffix not in DATABASES]
    try:
        proposal = look_at(database, logs[0] if logs else None, "tried")
    except UserError as error:
        return "refused", str(error).removeprefix(f"{database}: ")
    battery = proposal.battery.name if proposal.battery is not None else ""
    others = ", ".join(f"{item.branch} `{item.name}`" for item in proposal.branches if item.place != "battery")
    return battery, proposal.problem() or others


def main() -> None:
    """Print the table for the folder on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--right", type=Path)
    given = parser.parse_args()
    right = {}
    if given.right is not None:
        right = {row["database"]: row["battery"] for row in csv.DictReader(given.right.open(newline=""))}
    counts = Counter[str]()
    print("| database | result | battery current | the rest |\n|---|---|---|---|")
    for path in sorted(item for item in given.folder.rglob("*") if item.suffix.lower() in DATABASES):
        battery, rest = found_in(path)
        wanted = right.get(path.stem, None if battery else "")
        result = "refused" if battery == "refused" else "not known" if wanted is None else "none"
        if result == "none" and (battery or wanted):
            result = "right" if battery == wanted else "wrong"
        counts[result] += 1
        print(
            f"| {path.stem} | {result} | {f'`{battery}`' if battery not in {'', 'refused'} else ''} | {rest} |",
            flush=True,
        )
    print(", ".join(f"{result} {count}" for result, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
