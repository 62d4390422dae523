"""``python -m ecu_node`` and the console command."""

import sys
from contextlib import suppress

__all__ = ["main"]


def main() -> int:
    """Run the command line; Ctrl-C while it is imported ends it in one line, too."""
    try:
        from ecu_node.cli import main as run  # noqa: PLC0415
    except KeyboardInterrupt:
        if sys.stderr is not None:  # closed by who started the program
            with suppress(OSError):
                print("ecu-node: interrupted", file=sys.stderr, flush=True)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
