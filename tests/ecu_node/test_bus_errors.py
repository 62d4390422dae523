"""What the errors of a bus mean, whether or not this kernel has SocketCAN."""

import errno

import can
import pytest

from ecu_node.bus.adapters import error_text
from ecu_node.bus.steady_bus import is_of_frame, means_gone


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(errno.EAFNOSUPPORT, "Address family not supported"), "this kernel has no SocketCAN (modules "),
        (OSError(errno.ENODEV, "No such device"), "no such interface (see 'ip link')"),
        (can.CanOperationError("Transmit buffer full\nmore of it"), "Transmit buffer full"),
        (can.CanError(), "CanError"),
    ],
)
def test_an_error_is_told_in_one_line(error: Exception, text: str) -> None:
    assert error_text(error).startswith(text)
    assert "\n" not in error_text(error)


@pytest.mark.parametrize(
    ("number", "gone", "frame"),
    [
        (errno.ENETDOWN, True, False),
        (errno.ENODEV, True, False),
        (errno.EMSGSIZE, False, True),
        (errno.ENOBUFS, False, False),
    ],
)
def test_an_error_of_sending_is_known_by_its_number_from_python_can_and_from_the_kernel(
    number: int, gone: bool, frame: bool
) -> None:
    for error in (OSError(number, "x"), can.CanOperationError("x", number)):
        assert (means_gone(error), is_of_frame(error)) == (gone, frame)
