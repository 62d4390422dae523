"""python-can without asammdf, which it imports where that is installed: two seconds, numpy, pandas and sympy."""

import sys

__all__ = ["load_python_can"]


def load_python_can() -> None:
    """Import python-can without asammdf, which stays importable; for programs, as python-can then reads no MF4.

    Does nothing where one of both has been imported before.
    """
    if "can" in sys.modules or "asammdf" in sys.modules:
        return
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # documented: makes its import fail
    try:
        import can  # noqa: F401, PLC0415
    finally:
        del sys.modules["asammdf"]
