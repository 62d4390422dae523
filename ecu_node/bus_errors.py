"""What the errors mean that python-can's interfaces raise, which differ from one to the other."""

import errno

__all__ = ["error_text", "is_of_frame", "means_gone"]

_GONE = {errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF}
"""Errors of sending after which only opening the bus again helps."""


def means_gone(error: Exception) -> bool:
    """Whether after an error of sending only opening the bus again helps."""
    return _number(error) in _GONE


def is_of_frame(error: Exception) -> bool:
    """Whether it is this frame that the bus does not take, whatever its state, as one that is too long for it."""
    return _number(error) in {errno.EINVAL, errno.EMSGSIZE}


def error_text(error: Exception) -> str:
    """What went wrong, in one line; where it is known, what to do."""
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (try tools/with_vcan)"
    if isinstance(error, OSError) and error.errno == errno.ENODEV:
        return "no such interface (see 'ip link')"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _number(error: Exception) -> int | None:
    code = getattr(error, "error_code", None)
    return code if code is not None else getattr(error, "errno", None)
