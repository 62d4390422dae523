"""``python -m ecu_node`` and the console command."""

import sys

__all__ = ["main"]


def main() -> int:
    """Run the command line; Ctrl-C while it is imported ends it in one line, too."""
    try:
        from ecu_node.cli import main as run  # noqa: PLC0415
    except KeyboardInterrupt:
        print("ecu-node: interrupted", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
