"""``ecu-node run``: parameters, core, buses and service put together."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import can

from ecu_node.buses import carries_fd, open_bus
from ecu_node.check import warnings_of
from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase, node_database
from ecu_node.gateway_node import GatewayNode
from ecu_node.guard import Mode
from ecu_node.in_force import not_published
from ecu_node.overlay_node import OverlayNode
from ecu_node.parameter_file import ParameterFile, ParameterSource
from ecu_node.service import Log, Requests, ServiceManager
from ecu_node.state_changes import StateChanges
from ecu_node.steady_bus import SteadyBus
from ecu_node.wiring import wire

__all__ = ["RunOptions", "run_node"]

_DEFAULT_PERIOD_S = 0.1


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
    shadow : bool
        Compute and report, change nothing.
    metrics_port : int or None
        Port on which Prometheus may ask.
    """

    params: Path | None
    state: Path | None
    layout: Path
    vehicle: str | None
    interface: str
    channel: str
    gateway: str | None
    fd: bool
    shadow: bool
    metrics_port: int | None


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
    mode = Mode.OVERLAY if options.gateway is None else Mode.GATEWAY
    database = node_database(options.layout)
    file = _source(options, database, mode, say)
    corrector = wire(database, file.in_force, time.monotonic(), mode=mode, shadow=options.shadow)
    buses = []
    try:
        for channel in (options.channel, options.gateway):
            if channel is None:
                break
            buses.append(SteadyBus(_opener(database, options, channel, mode), corrector.counters, say))
        requests = Requests()
        if options.metrics_port is not None:
            from ecu_node.metrics import serve_metrics  # noqa: PLC0415  # prometheus_client is optional

            serve_metrics(corrector, options.metrics_port)
        if options.params is not None:
            say("parameters are used that nobody signed (--unsigned)")
        if file.why_not is not None:
            say(f"passing measured values through: {file.why_not}")
        elif options.params is not None and options.vehicle is None:
            say(f"the vehicle is not checked: {vehicle_hint}")
        for text in (*warnings_of(database, file.in_force, mode, fd=options.fd), *_unseen(options)):
            say(text)
        what = _what(corrector, database, file, mode)
        where = f"{options.interface} {options.channel}{f' to {options.gateway}' if options.gateway else ''}"

        def ready() -> None:
            say(f"running on {where}{', shadow mode' if options.shadow else ''}, correcting {what or 'nothing'}")
            manager.ready(f"correcting {what or 'nothing'}")

        tick = _Tick(corrector=corrector, buses=buses, file=file, requests=requests, manager=manager, say=say)
        period_s = database.layout.status.period_s if database.layout.status is not None else _DEFAULT_PERIOD_S
        try:
            _node(buses, corrector, database, period_s, tick).run(requests.stop, ready)
        finally:
            manager.stopping()
            say(f"ended: {corrector.counters.text()}")
    finally:
        for bus in buses:
            bus.close()
    return 0


def _opener(database: VehicleDatabase, options: RunOptions, channel: str, mode: Mode) -> Callable[[], can.BusABC]:
    return lambda: open_bus(database, interface=options.interface, channel=channel, fd=options.fd, mode=mode)


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
    buses: list[SteadyBus], corrector: Corrector, database: VehicleDatabase, period_s: float, tick: "_Tick"
) -> OverlayNode | GatewayNode:
    if len(buses) == 1:
        return OverlayNode(buses[0], corrector, database, period_s=period_s, on_tick=tick)
    return GatewayNode(buses[0], buses[1], corrector, database, period_s=period_s, on_tick=tick)


class _Tick:
    """What is done beside the frames: watchdog, parameters, and a line in the log when the state changes."""

    def __init__(
        self,
        *,
        corrector: Corrector,
        buses: Sequence[SteadyBus],
        file: ParameterSource,
        requests: Requests,
        manager: ServiceManager,
        say: Callable[[str], None],
    ) -> None:
        self._corrector, self._buses, self._file, self._requests = corrector, buses, file, requests
        self._manager, self._say = manager, say
        self._changes = StateChanges(corrector)

    def __call__(self, now_s: float, works: bool) -> None:
        corrector = self._corrector
        if works:
            self._manager.alive(now_s)
        for bus in self._buses:
            bus.count_dropped()
        if self._file.look(corrector, now_s, asked=self._requests.take_reload()):
            self._manager.status(f"parameter set {corrector.parameter_set} is in force")
        text = self._changes.news()
        if text is not None:
            self._say(text)
            self._manager.status(text)


def _what(corrector: Corrector, database: VehicleDatabase, file: ParameterSource, mode: Mode) -> str:
    hidden = not_published(database, file.in_force) if mode is Mode.OVERLAY else []
    return ", ".join(item.name for item in corrector.branches if item.fault.applied and item.name not in hidden)
