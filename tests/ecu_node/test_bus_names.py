"""The name of a bus in messages."""

import pytest

from ecu_node.bus.adapters import carries_fd, connect
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.core.status import Counters
from ecu_node.errors import BusError


@pytest.mark.parametrize(
    ("interface", "channel", "name"),
    [
        ("virtual", "bench", "Virtual bus channel bench"),
        ("udp_multicast", "239.74.163.2", "udp_multicast 239.74.163.2"),  # tells nothing of itself
    ],
)
def test_a_bus_is_named_in_messages(interface: str, channel: str, name: str) -> None:
    try:
        bus = SteadyBus(lambda: connect(interface, channel), Counters())
    except BusError as error:
        pytest.skip(str(error))
    try:
        assert bus.channel == name
    finally:
        bus.close()


@pytest.mark.parametrize(("interface", "channel"), [("virtual", "can0"), ("socketcan", "nobus0")])
def test_of_a_bus_of_which_nothing_is_known_no_can_fd_is_claimed(interface: str, channel: str) -> None:
    assert not carries_fd(interface, channel)
