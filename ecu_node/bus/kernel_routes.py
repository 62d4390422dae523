"""Lets the kernel carry the frames that a gateway only passes on, by rules of its module can-gw that outlive the node.

Rules are set over netlink, not by the program ``cangw``: a rule then takes microseconds instead of a process, its error
is a number, and rules can be read back and compared. A rule copies the frames that its one filter matches, so several
identifiers can be left out only by filters for all others. The kernel routes no frame twice, and none back to where it
came from (net/can/gw.c); structures are those of linux/can/gw.h and linux/netlink.h.
"""

import errno
import os
import socket
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from typing import NamedTuple, Self

from ecu_node.errors import BusError, UserError

_NEW, _DELETE, _GET = 24, 25, 26
"""RTM_NEWROUTE, RTM_DELROUTE, RTM_GETROUTE."""
_REQUEST, _ACKNOWLEDGE, _DUMP = 0x1, 0x4, 0x300
_ERROR, _DONE = 2, 3
_MESSAGE = struct.Struct("=IHHII")
"""struct nlmsghdr: length, kind, flags, and two numbers that are not used here."""
_RULE = struct.Struct("=BBH")
"""struct rtcanmsg: family, kind, flags."""
_CAN_TO_CAN, _ECHO, _FD = 1, 0x1, 0x8
_ATTRIBUTE = struct.Struct("=HH")
"""struct nlattr: length, number of the attribute."""
_ATTRIBUTES = struct.Struct("=HHI HHI HHII HHB3x")
"""Attributes of a rule: source, target, filter and hop limit, each with its length and number."""
_FROM, _TO, _FILTER, _LIMIT = 9, 10, 11, 13
_COUNTERS = {7, 8, 12}
"""Attributes with counts of the frames that were handled, dropped, and not routed again."""
_EXTENDED = 0x80000000
_LOOK_EVERY_S = 2.0
_LONGEST_ANSWER_S = 1.0
"""Longest wait for an answer of the kernel, which answers at once. [s]"""


def complement(taken: Collection[int], bits: int) -> Iterator[tuple[int, int]]:
    """Yield pairs of identifier and mask that match each identifier of `bits` bits once, except those taken."""

    def cover(prefix: int, free: int) -> Iterator[tuple[int, int]]:
        if not any(identifier >> free == prefix for identifier in taken):
            yield prefix << free, (1 << bits) - (1 << free)
        elif free:
            yield from cover(2 * prefix, free - 1)
            yield from cover(2 * prefix + 1, free - 1)

    return cover(0, bits)


class _Route(NamedTuple):
    """One rule of can-gw: flags, indices of the two interfaces, and the filter for identifiers."""

    flags: int
    source: int
    target: int
    can_id: int
    can_mask: int


class KernelRoutes:
    """The kernel's rules between two buses, in both directions.

    Leaving the context removes them, except by an exception that is no :class:`UserError`.

    Parameters
    ----------
    channels : tuple of str
        The two interfaces of SocketCAN.
    ours : collection of tuple
        Identifiers, each with whether it has 29 bits, that the kernel must not carry.
    fd : bool
        Whether the kernel carries CAN FD frames, too (Linux 5.4 or newer).
    say : callable
        Takes one line for the log.

    Raises
    ------
    OSError
        If the kernel takes no rules: EPERM without CAP_NET_ADMIN, EOPNOTSUPP without the module.
    BusError
        If another gateway on this computer works between these buses, or left rules that nobody here may change.
    """

    def __init__(
        self, channels: tuple[str, str], ours: Collection[tuple[int, bool]], *, fd: bool, say: Callable[[str], None]
    ) -> None:
        self._channels, self._say, self._said = channels, say, ""
        self._due_s = float("inf")
        filters = [
            (flag | identifier, _EXTENDED | mask)
            for flag, bits in ((0, 11), (_EXTENDED, 29))
            for identifier, mask in complement([key for key, extended in ours if extended == bool(flag)], bits)
        ]
        self._kinds = [(flags, *pair) for flags in ((_ECHO, _ECHO | _FD) if fd else (_ECHO,)) for pair in filters]
        one, other = sorted(map(socket.if_nametoindex, channels))
        self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE)
        self._socket.settimeout(_LONGEST_ANSWER_S)
        where = " and ".join(channels)
        try:
            # Two gateways between the same buses would need the same port; it is above those that are process numbers.
            self._socket.bind((1 << 30 | one << 15 | other, 0))
        except OSError:
            raise BusError(f"{where}: another gateway works between them on this computer; stop one") from None
        try:
            self._change(_DELETE, _Route(0, one, one, 0, 0))  # no such rule exists: EINVAL if we may delete, else EPERM
        except OSError as error:
            if error.errno == errno.EPERM and self._present():
                raise BusError(
                    f"{where}: an earlier gateway left rules in the kernel, which only CAP_NET_ADMIN may change; give "
                    f"that capability to this one, or remove them with 'cangw -F'"
                ) from None
            if error.errno != errno.EINVAL:
                raise

    def set(self) -> None:
        """Set all rules, in both directions, or none; rules of an earlier gateway stay if they are correct.

        Other rules between the two buses that a gateway left are deleted.

        Raises
        ------
        BusError
            If the kernel refuses one.
        """
        try:
            self._replace(self._wanted())
        except OSError as error:
            self.remove()
            raise BusError(f"{' and '.join(self._channels)}: the kernel refuses a rule of can-gw: {error}") from None
        self._due_s = float("-inf")

    def look(self, now_s: float) -> None:
        """Check every few seconds that all rules are there, and set missing ones: rules vanish with their interface."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + _LOOK_EVERY_S
        try:
            changed = self._replace(self._wanted())
            text = f"{changed} rules of the kernel were not as they must be; they are now" if changed else ""
        except OSError as error:
            text = f"the kernel carries no frames: {error}"
        if text not in {"", self._said}:
            self._say(f"{' and '.join(self._channels)}: {text}")
        self._said = text

    def remove(self) -> None:
        """Remove all rules, in both directions."""
        with suppress(OSError):  # an interface may vanish just now, with its rules
            self._replace(Counter())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or issubclass(kind, UserError):
            self.remove()
        self._socket.close()

    def _wanted(self) -> Counter[_Route]:
        """Return the rules that must be set, in both directions."""
        one, other = map(socket.if_nametoindex, self._channels)
        ways = (one, other), (other, one)
        return Counter(_Route(flags, *way, *pair) for way in ways for flags, *pair in self._kinds)

    def _present(self) -> Counter[_Route]:
        """Return the rules of a gateway between these buses: those with a hop limit that change no frame."""
        ends = set(map(socket.if_nametoindex, self._channels))
        found = map(_route, self._ask(_GET, _DUMP, _RULE.pack(socket.AF_CAN, _CAN_TO_CAN, 0)))
        return Counter(route for route in found if route is not None and {route.source, route.target} == ends)

    def _replace(self, wanted: Counter[_Route]) -> int:
        """Replace the rules by these; return how many were surplus or missing."""
        present = self._present()
        surplus, missing = present - wanted, wanted - present
        for kind, routes in ((_DELETE, surplus), (_NEW, missing)):
            for route in routes.elements():
                self._change(kind, route)
        return surplus.total() + missing.total()

    def _change(self, kind: int, route: _Route) -> None:
        """Set or delete one rule; raise OSError if the kernel refuses."""
        flags, source, target, *pair = route
        attributes = _ATTRIBUTES.pack(8, _FROM, source, 8, _TO, target, 12, _FILTER, *pair, 5, _LIMIT, 1)
        self._ask(kind, _ACKNOWLEDGE, _RULE.pack(socket.AF_CAN, _CAN_TO_CAN, flags) + attributes)

    def _ask(self, kind: int, flags: int, body: bytes) -> list[bytes]:
        """Send a request to the kernel; return its answers, without headers."""
        self._socket.send(_MESSAGE.pack(_MESSAGE.size + len(body), kind, _REQUEST | flags, 0, 0) + body)
        found: list[bytes] = []
        while True:
            answer, at = self._socket.recv(1 << 16), 0
            while at < len(answer):
                length, what, *_ = _MESSAGE.unpack_from(answer, at)
                payload = answer[at + _MESSAGE.size : at + length]
                if what == _ERROR and (code := -struct.unpack_from("=i", payload)[0]):
                    raise OSError(code, os.strerror(code))
                if what in {_ERROR, _DONE}:  # an error of 0 acknowledges
                    return found
                found.append(payload)
                at += length + 3 & ~3


def _route(payload: bytes) -> _Route | None:
    """Decode a rule that the kernel reports; None for one that no gateway sets."""
    _, _, flags = _RULE.unpack_from(payload)
    found, at = {}, _RULE.size
    while at < len(payload):
        length, number = _ATTRIBUTE.unpack_from(payload, at)
        found[number] = payload[at + _ATTRIBUTE.size : at + length]
        at += length + 3 & ~3
    if found.keys() - _COUNTERS != {_FROM, _TO, _FILTER, _LIMIT}:
        return None
    numbers = struct.unpack("=IIII", found[_FROM] + found[_TO] + found[_FILTER])
    return _Route(flags, *numbers)


def kernel_routes(
    channels: tuple[str, str], ours: Collection[tuple[int, bool]], *, fd: bool, say: Callable[[str], None]
) -> KernelRoutes | None:
    """Make the rules by which the kernel carries all identifiers but ours; they hold from :meth:`KernelRoutes.set` on.

    ``ours`` are identifiers, each with whether it has 29 bits. The result is None if the kernel takes no rules, which
    `say` is told, or if an interface is missing, which opening the bus says: the node then carries all frames.
    BusError as :class:`KernelRoutes`.
    """
    if set(channels) - {name for _, name in socket.if_nameindex()}:
        return None  # opening the bus says so
    try:
        return KernelRoutes(channels, ours, fd=fd, say=say)
    except OSError as error:
        needed = {errno.EPERM: "CAP_NET_ADMIN is needed", errno.EOPNOTSUPP: "its module can-gw is needed"}
        say(
            f"{' and '.join(channels)}: the kernel carries no frames ({needed.get(error.errno or 0, error)}), so this "
            f"program carries them all, and they stop when it does"
        )
        return None
