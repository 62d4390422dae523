"""Entry point of ``python -m ecu_node`` and of the console command."""

import sys
from contextlib import suppress

__all__ = ["ecu_node_program"]


def ecu_node_program() -> int:
    """Run the command line; Ctrl-C ends it in one line even while its modules are being imported."""
    try:
        from ecu_node.cli import run_ecu_node  # noqa: PLC0415
    except KeyboardInterrupt:
        if sys.stderr is not None:  # closed by who started the program
            with suppress(OSError):
                print("ecu-node: interrupted", file=sys.stderr, flush=True)
        return 130
    return run_ecu_node()


if __name__ == "__main__":
    sys.exit(ecu_node_program())
