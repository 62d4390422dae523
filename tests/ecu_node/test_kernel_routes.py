"""Which identifiers a gateway's rules cover; that the kernel follows them is tested in tests/vcan."""

import pytest

from ecu_node.bus.kernel_routes import complement, kernel_routes


@pytest.mark.parametrize(
    "taken",
    [(), (0,), (0x7FF,), (0x110, 0x120, 0x130, 0x5F0), (0x110, 0x111), pytest.param(tuple(range(300)), id="0 to 299")],
)
def test_kernel_rules_cover_each_untaken_11_bit_identifier_exactly_once(taken: tuple[int, ...]) -> None:
    pairs = list(complement(taken, 11))
    covered = [sum(identifier & mask == prefix for prefix, mask in pairs) for identifier in range(2048)]
    assert covered == [int(identifier not in taken) for identifier in range(2048)]


def test_missing_interface_gets_no_kernel_rules_and_no_log_line() -> None:
    said: list[str] = []
    assert kernel_routes(("lo", "no_such_bus"), {(0x110, False)}, fd=False, say=said.append) is None
    assert said == []
