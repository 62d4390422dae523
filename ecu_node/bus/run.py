"""``ecu-node run``: parameters, core, buses and service put together."""

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import can
from cantools.database.can import Message

from ecu_node.bus.adapters import acknowledgement, bus_config, config_text
from ecu_node.bus.faults import FaultMemory
from ecu_node.bus.guard import Mode, received, rewritten, transmitted
from ecu_node.bus.in_force import ParameterFile, ParameterSource, not_published
from ecu_node.bus.kernel_routes import KernelRoutes, kernel_routes
from ecu_node.bus.links import carries_fd, open_bus, require_fd
from ecu_node.bus.node import GatewayNode, OverlayNode
from ecu_node.bus.service import Log, Requests, ServiceManager, be_real_time
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.telemetry import Latency, Telemetry
from ecu_node.bus.wiring import wire
from ecu_node.check import warnings_of
from ecu_node.core.corrector import OF_ONE_DRIVE, Corrector
from ecu_node.core.frames import FrameKey
from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase, node_database
from ecu_node.program import write_text

__all__ = ["RunOptions", "StateChanges", "run_node"]


class StateChanges:
    """Looks for changes of the state; those of the parameters are told by who reads them.

    Parameters
    ----------
    corrector : Corrector
        The core.
    """

    def __init__(self, corrector: Corrector) -> None:
        self._corrector = corrector
        self._before = Reason.NONE, False

    def news(self) -> str | None:
        """One line on what has changed since the last time; None if nothing has."""
        corrector = self._corrector
        before = self._before
        latched, asleep = self._before = corrector.latched, corrector.is_asleep
        if self._before == before:
            return None
        if latched not in {before[0], Reason.NONE}:
            return f"passing measured values through until {self._until()}: {self._why()}"
        if asleep != before[1]:
            return "the bus sleeps" if asleep else "the bus is awake again"
        return "correcting again" if corrector.reason is Reason.NONE and not asleep else None

    def _until(self) -> str:
        return (
            "the bus has slept" if self._corrector.latched in OF_ONE_DRIVE else "other parameters or 'ecu-node clear'"
        )

    def _why(self) -> str:
        names = self._corrector.latched_branches
        which = ", ".join(names)
        match self._corrector.latched:
            case Reason.BRANCH_STALE:
                return f"no frames of {which}"
            case Reason.BRANCH_STUCK:
                return f"{which} never changes"
            case Reason.SUM_IMPLAUSIBLE:
                return (
                    f"the Kirchhoff sum is not what it may be; most likely the sensor of {' or '.join(names)} is wrong"
                )
        return "the corrected Kirchhoff sum is worse than the measured one"


_DEFAULT_PERIOD_S = 0.1
_GARBAGE = 10_000
"""Objects that were made and not freed, after which garbage is looked for among them, in about a millisecond."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What was asked for on the command line.

    Attributes
    ----------
    params : Path or None
        Parameter file that nobody signed.
    state : Path or None
        State of the vehicle, with signed parameters; one of the two is given.
    layout : Path
        Layout.
    vehicle : str or None
        Identity of the vehicle; None: not checked, or as the state says.
    interface, channel : str
        Bus of the sensors, as python-can names it.
    gateway : str or None
        Channel of the bus on the other side; None: overlay.
    fd : bool
        Whether to use CAN FD.
    listen_only, bitrates :
        As for :func:`ecu_node.bus.adapters.bus_config`.
    shadow : bool
        Compute and report, change nothing.
    dry_run : bool
        Print what would be opened, read and sent, and open nothing.
    metrics_port : int or None
        Port on which Prometheus may ask.
    telemetry : Path, tuple of str and int, or None
        File, or host and UDP port, for a line per second.
    realtime : bool
        Whether to run as a real-time process.
    """

    params: Path | None
    state: Path | None
    layout: Path
    vehicle: str | None
    interface: str
    channel: str
    gateway: str | None
    fd: bool
    listen_only: bool
    bitrates: Mapping[str, int | None]
    shadow: bool
    dry_run: bool
    metrics_port: int | None
    telemetry: Path | tuple[str, int] | None
    realtime: bool


def run_node(options: RunOptions, vehicle_hint: str) -> int:
    """Run a node until SIGTERM or SIGINT.

    Parameters
    ----------
    options : RunOptions
        What was asked for.
    vehicle_hint : str
        What to do for the vehicle to be checked.

    Returns
    -------
    int
        Exit code 0.

    Raises
    ------
    UserError
        If layout, DBC or bus cannot be used, or another node is on the bus.
    """
    say, manager = Log().say, ServiceManager()
    if options.realtime:
        say(be_real_time())
    mode = Mode.OVERLAY if options.gateway is None else Mode.GATEWAY
    database = node_database(options.layout)
    file = _source(options, database, mode, say)
    corrector = wire(database, file.in_force, time.monotonic(), mode=mode, shadow=options.shadow)
    channels = [channel for channel in (options.channel, options.gateway) if channel is not None]
    if options.dry_run:
        write_text(_dry_run(database, options, channels, mode))
        return 0
    routes = None
    if options.gateway is not None and options.interface == "socketcan":
        routes = kernel_routes((options.channel, options.gateway), database, fd=options.fd, say=say)
    buses, latency = list[SteadyBus](), Latency()
    try:
        for channel in channels:
            opener = _opener(database, options, channel, mode, routes)
            buses.append(SteadyBus(opener, corrector.counters, say, listen_only=options.listen_only))
        requests = Requests()
        if options.metrics_port is not None:
            from ecu_node.bus.service import serve_metrics  # noqa: PLC0415  # prometheus_client is optional

            serve_metrics(corrector, latency, options.metrics_port)
        for text in (
            *_notes(options, file, vehicle_hint),
            *warnings_of(database, file.in_force, mode, fd=options.fd),
            *_unseen(options),
        ):
            say(text)
        if options.listen_only:
            say(acknowledgement(options.interface, options.channel))
        what = _what(corrector, database, file, mode)
        where = f"{options.interface} {options.channel}{f' to {options.gateway}' if options.gateway else ''}"

        def ready() -> None:
            if routes is not None:
                routes.set()
            say(f"running on {where}{', shadow mode' if options.shadow else ''}, correcting {what or 'nothing'}")
            manager.ready(f"correcting {what or 'nothing'}")

        memory = FaultMemory(corrector, options.state, say, ThreadPoolExecutor(1, "faults")) if options.state else None
        telemetry = (
            Telemetry(options.telemetry, corrector, layout=database.layout, latency=latency, buses=buses, say=say)
            if options.telemetry is not None
            else None
        )
        tick = _Tick(
            corrector=corrector,
            buses=buses,
            routes=routes,
            file=file,
            memory=memory,
            telemetry=telemetry,
            requests=requests,
            manager=manager,
            say=say,
        )
        period_s = database.layout.status.period_s if database.layout.status is not None else _DEFAULT_PERIOD_S
        try:
            with routes or nullcontext():
                routed = routes is not None
                node = _node(buses, corrector, database, period_s, tick=tick, latency=latency, routed=routed)
                _freeze()
                node.run(requests.stop, ready)
        finally:
            manager.stopping()
            say(f"ended: {corrector.counters.text()}")
    finally:
        for bus in buses:
            bus.close()
    return 0


def _freeze() -> None:
    """Leave what was made at the start out of all garbage collections; others come only when something grows."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_GARBAGE)


def _opener(
    database: VehicleDatabase, options: RunOptions, channel: str, mode: Mode, routes: KernelRoutes | None
) -> Callable[[], can.BusABC]:
    return lambda: open_bus(
        database,
        interface=options.interface,
        channel=channel,
        fd=options.fd,
        mode=mode,
        routed=routes is not None,
        own=not options.listen_only,  # a node that only listens may stand beside the one that sends
        listen_only=options.listen_only,
        bitrates=options.bitrates,
    )


def _notes(options: RunOptions, file: ParameterSource, vehicle_hint: str) -> Iterator[str]:
    """What to know of the parameters."""
    if options.params is not None:
        yield "parameters are used that nobody signed (--unsigned)"
    if file.why_not is not None:
        yield f"passing measured values through: {file.why_not}"
    elif options.params is not None and options.vehicle is None:
        yield f"the vehicle is not checked: {vehicle_hint}"


def _dry_run(database: VehicleDatabase, options: RunOptions, channels: Sequence[str], mode: Mode) -> str:
    """What a node with these options would open, read and send."""
    require_fd(database, mode, fd=options.fd)
    read, written = _names(received(database)), _names(transmitted(database, mode))
    if mode is Mode.GATEWAY:
        others = "all other frames of the other bus, as they are"
        reads = [f"all frames; corrects {_names(rewritten(database))}", "all frames"]
        sends = [others, f"{_names(rewritten(database))}, corrected; {written}; {others}"]
    else:
        reads, sends = [read], ["nothing" if options.listen_only else written]
    lines = []
    for channel, reading, sending in zip(channels, reads, sends, strict=True):
        config = bus_config(
            options.interface, channel, fd=options.fd, listen_only=options.listen_only, bitrates=options.bitrates
        )
        lines += [f"would open {config_text(config)}", f"  reads {reading}", f"  sends {sending}"]
    if options.listen_only:
        lines.append(acknowledgement(options.interface, options.channel))
    return "\n".join(lines)


def _names(messages: Mapping[FrameKey, Message]) -> str:
    return ", ".join(f"{message.name} (0x{key.identifier:X})" for key, message in messages.items()) or "nothing"


def _source(options: RunOptions, database: VehicleDatabase, mode: Mode, say: Callable[[str], None]) -> ParameterSource:
    if options.params is not None:
        return ParameterFile(options.params, database, options.vehicle, mode=mode, say=say)
    from ecu_node.trust.parameter_store import ParameterStore  # noqa: PLC0415  # cryptography takes time to import

    assert options.state is not None
    return ParameterStore(
        options.state,
        database,
        mode=mode,
        say=say,
        now=lambda: datetime.now(UTC),
        vehicle=options.vehicle,
        background=ThreadPoolExecutor(1, "state of the vehicle"),
    )


def _unseen(options: RunOptions) -> list[str]:
    """What a gateway would not pass on, as the kernel does not show it CAN FD frames."""
    if options.gateway is None or options.fd:
        return []
    names = [name for name in (options.channel, options.gateway) if carries_fd(options.interface, name)]
    if not names:
        return []
    return [f"{' and '.join(names)}: set up for CAN FD, of which nothing is passed on without --fd"]


def _node(
    buses: list[SteadyBus],
    corrector: Corrector,
    database: VehicleDatabase,
    period_s: float,
    *,
    tick: "_Tick",
    latency: Latency,
    routed: bool,
) -> OverlayNode | GatewayNode:
    if len(buses) == 1:
        return OverlayNode(buses[0], corrector, database, period_s=period_s, on_tick=tick, latency=latency)
    return GatewayNode(
        buses[0], buses[1], corrector, database, period_s=period_s, on_tick=tick, latency=latency, routed=routed
    )


@dataclass(kw_only=True)
class _Tick:
    """What is done beside the frames: watchdog, parameters, and a line in the log when the state changes."""

    corrector: Corrector
    buses: Sequence[SteadyBus]
    file: ParameterSource
    memory: FaultMemory | None
    routes: KernelRoutes | None = None
    telemetry: Telemetry | None = None
    requests: Requests
    manager: ServiceManager
    say: Callable[[str], None]

    def __post_init__(self) -> None:
        self._changes = StateChanges(self.corrector)

    def __call__(self, now_s: float, works: bool) -> None:
        corrector = self.corrector
        if works:
            self.manager.alive(now_s)
        for bus in self.buses:
            bus.count_dropped()
        if self.file.look(corrector, now_s, asked=self.requests.take_reload()):
            self.manager.status(f"parameter set {corrector.parameter_set} is in force")
        if self.memory is not None:
            self.memory.look(now_s)
        if self.telemetry is not None:
            self.telemetry.look(now_s)
        if self.routes is not None:
            self.routes.look(now_s)
        text = self._changes.news()
        if text is not None:
            self.say(text)
            self.manager.status(text)


def _what(corrector: Corrector, database: VehicleDatabase, file: ParameterSource, mode: Mode) -> str:
    hidden = not_published(database, file.in_force) if mode is Mode.OVERLAY else []
    return ", ".join(item.name for item in corrector.branches if item.fault.applied and item.name not in hidden)
