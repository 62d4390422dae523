"""``python -m calibrator`` and the console command; the base install has the node alone.

All that takes time is imported inside a function, so that Ctrl-C and a closed pipe end it the same way at any time.
"""

import signal
import sys
from collections.abc import Callable
from importlib import import_module

from calibrator.processes.interrupts import ending_at_sigterm, importing, interrupted_message
from ecu_node.errors import UserError
from ecu_node.program import INTERRUPTED, drop_output, flush_output, load_python_can, say_error

__all__ = ["calibrator_program"]


def calibrator_program() -> None:
    """Run the command line; exit code 0 done, 1 failed, 2 wrong use, 70 internal, 130 interrupted, 143 SIGTERM."""
    ending_at_sigterm()
    try:
        code = _run()
        flush_output()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except UserError as error:
        say_error(f"calibrator: {error}")
        code = 1
    except BrokenPipeError:
        drop_output()
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done or undone; threads only have to be joined
    if code == INTERRUPTED:
        say_error(interrupted_message(sys.argv[1:]))
    raise SystemExit(code)


def _run() -> int:
    try:
        with importing():
            load_python_can()
            run: Callable[[], int] = import_module("calibrator.cli").run_calibrator
    except ModuleNotFoundError as error:
        say_error(f"calibrator: {error.name} is not installed; pip install 'hv-current-correction[calibrator]'")
        return 1
    return run()


if __name__ == "__main__":
    calibrator_program()
