"""Start the calibrator as ``python -m calibrator`` or console command; say what to install if packages are missing.

Slow modules are imported inside a function, so that Ctrl-C is handled during imports as it is later.
"""

import signal
import sys
from collections.abc import Callable
from importlib import import_module

from calibrator.processes.interrupts import ending_at_sigterm, importing, interrupted_message
from ecu_node.errors import UserError
from ecu_node.program import INTERRUPTED, flush_output, load_python_can, say_error

__all__ = ["calibrator_program"]


def calibrator_program() -> None:
    """Run the command line and end the process.

    Exit codes: 0 done, 1 failed, 2 wrong use, 70 a fault of the program, 130 Ctrl-C, 143 SIGTERM.
    """
    ending_at_sigterm()
    try:
        code = _run()
        flush_output()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except UserError as error:
        say_error(f"calibrator: {error}")
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # work is finished or rolled back; only threads are left to join
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
