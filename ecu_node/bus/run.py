"""``ecu-node run``: parameters, core, buses and service put together; ``ecu-node check``: what a run would apply.

Parts that have something to do besides the frames, such as the fault memory and the telemetry, have a method ``look``
and are in the lists ``looks`` or ``records`` of :func:`run_node`. ``look`` is called every 20 ms, just after the
junction was looked at; ``corrector.watch`` then has the currents of all branches: ``instant_s`` and ``currents_a``
(measured and corrected).
"""

import argparse
import gc
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cantools.database.can import Message

from ecu_node.bus.adapters import acknowledgement, bus_config, carries_fd, config_text
from ecu_node.bus.faults import FaultMemory
from ecu_node.bus.kernel_routes import kernel_routes
from ecu_node.bus.node import Node
from ecu_node.bus.service import Log, ServiceManager, be_real_time, stopped_by
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.telemetry import Telemetry
from ecu_node.bus.wiring import (
    InForce,
    Mode,
    branch_plan,
    choose_parameters,
    narrowed,
    needs_fd,
    open_bus,
    received,
    require_fd,
    rewritten,
    transmitted,
    unpublished,
    unsealed,
    wire,
)
from ecu_node.core.corrector import OF_ONE_DRIVE, Corrector
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Latency, Reason
from ecu_node.database import VehicleDatabase, node_database
from ecu_node.errors import printable
from ecu_node.layout import Branch
from ecu_node.program import write_output

if TYPE_CHECKING:
    from ecu_node.update.store import ParameterStore


class StateChanges:
    """Notes changes of the node's state for the log; changes of the parameters are logged where they are read.

    Parameters
    ----------
    corrector : Corrector
        The core.
    has_memory : bool
        Whether there is a fault memory to be cleared.
    """

    def __init__(self, corrector: Corrector, *, has_memory: bool = True) -> None:
        self._corrector = corrector
        self._released_by = "other parameters or 'ecu-node clear'" if has_memory else "a restart"
        self._before = Reason.NONE, False

    def news(self) -> str | None:
        """Return one line on what has changed since the last call; None if nothing has."""
        corrector = self._corrector
        latched_before, asleep_before = self._before
        latched, asleep = self._before = corrector.latched, corrector.is_asleep
        if latched not in {latched_before, Reason.NONE}:
            until = "the bus has slept" if latched in OF_ONE_DRIVE else self._released_by
            names = (" or " if latched is Reason.SUM_IMPLAUSIBLE else ", ").join(corrector.latched_branches)
            return f"passing measured values through until {until}: {latched.words}{names and f' ({names})'}"
        if asleep != asleep_before:
            return "no branch sends" if asleep else "branches send again"
        corrects_again = latched != latched_before and corrector.reason is Reason.NONE and not asleep
        return "correcting again" if corrects_again else None


_DEFAULT_PERIOD_S = 0.1
_GARBAGE = 10_000
"""Number of new objects after which garbage is looked for among them, which takes about a millisecond."""


def run_node(options: argparse.Namespace, bus: Mapping[str, Any]) -> int:  # noqa: PLR0915 (in the order of a run)
    """Run a node until SIGTERM or SIGINT.

    Parameters
    ----------
    options : argparse.Namespace
        Options of ``ecu-node run``, see :mod:`ecu_node.cli`.
    bus : mapping
        Bus of the sensors, as the arguments of :func:`ecu_node.bus.adapters.bus_config`; a gateway's other bus differs
        in its channel only.

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
    is_gateway = options.gateway is not None
    mode = Mode.GATEWAY if is_gateway else Mode.OVERLAY
    bus_settings = [bus, {**bus, "channel": options.gateway}] if is_gateway else [bus]
    database = node_database(options.layout)
    store = _store(options, database, mode, say) if options.state is not None else None
    in_force = store.in_force if store is not None else choose_parameters(options.params, database, options.vehicle)
    corrector = wire(database, in_force, time.monotonic(), mode=mode, shadow=options.shadow)
    if options.dry_run:
        text = _dry_run(bus_settings, database, mode)
        write_output(text if in_force.why_not is None else f"{text}\nwould correct nothing: {in_force.why_not}")
        return 0
    routes = None
    if is_gateway and options.interface == "socketcan":
        routes = kernel_routes(
            (options.channel, options.gateway), corrector.own_keys | corrector.branch_keys, fd=options.fd, say=say
        )
    latency = Latency()
    with ExitStack() as closed_at_end:
        # A node that only listens may stand beside the one that sends.
        opener = partial(open_bus, database, mode=mode, routed=routes is not None, own=not options.listen_only)
        opened = (
            SteadyBus(partial(opener, **settings), corrector.counters, say, listen_only=options.listen_only)
            for settings in bus_settings
        )
        buses = [closed_at_end.enter_context(closing(bus)) for bus in opened]
        stop = stopped_by(signal.SIGTERM, signal.SIGINT)
        for text in _notes(options, in_force.why_not):
            say(text)

        def correcting(in_force: InForce) -> str:
            """Return which branches are corrected; log which are not, though they have a fault."""
            hidden = unpublished(database, in_force, mode)
            for text in hidden.values():
                say(text)
            faulty = [
                branch.name for branch in corrector.branches if branch.fault.applied and branch.name not in hidden
            ]
            if corrector.latched:  # its reason is in the next line of the log
                return "correcting nothing"
            sends_nothing = " (only in its figures: --listen-only)" if options.listen_only else ""
            return f"correcting {', '.join(faulty) or 'nothing'}{sends_nothing}"

        to, shadow = f" to {options.gateway}" if is_gateway else "", ", shadow mode" if options.shadow else ""
        running, is_said = f"running on {options.interface} {options.channel}{to}{shadow}", False

        def ready() -> None:
            if routes is not None:
                routes.set()
            manager.ready("waiting for the bus")

        looks: list[Callable[[float], None]] = [] if routes is None else [routes.look]
        records: list[Callable[[float], None]] = []
        if options.state is not None:
            looks.append(FaultMemory(corrector, options.state, say, ThreadPoolExecutor(1, "faults")).look)
        if options.telemetry is not None:
            records.append(Telemetry(options.telemetry, corrector, database.layout, latency, buses, say).look)
        if options.summary is not None:
            from ecu_node.bus.on_board_summary import on_board_summary  # noqa: PLC0415  # nothing else needs statistics

            summing = on_board_summary(options, bus, database, in_force.parameters, say)
            records.append(closed_at_end.enter_context(closing(summing)).look)
        changes = StateChanges(corrector, has_memory=options.state is not None)

        def tick(now_s: float, works: bool) -> None:
            if works:
                manager.alive(now_s)
            nonlocal is_said
            for each in buses:
                each.count_dropped()
            if not is_said and all(each.state != "gone" for each in buses):
                is_said = True
                now_correcting = correcting(in_force if store is None else store.in_force)
                say(f"{running}, {now_correcting}")
                manager.status(now_correcting)
            if store is not None and store.look(corrector, now_s):
                manager.status(f"parameter set {corrector.parameter_set} is in force, {correcting(store.in_force)}")
            for look in looks:
                look(now_s)
            for look in [*records]:
                try:
                    look(now_s)
                except Exception as error:  # noqa: BLE001  # what only records must not end the correction
                    records.remove(look)
                    what = type(look.__self__).__name__  # type: ignore[attr-defined]
                    say(
                        f"internal error in {what}, which is off now; please report it: {type(error).__name__}: {error}"
                    )
            if text := changes.news():
                say(text)
                manager.status(text)

        closed_at_end.callback(lambda: say(f"ended: {corrector.counters.text()}"))
        closed_at_end.callback(manager.stopping)
        if routes is not None:
            closed_at_end.enter_context(routes)
        status = database.layout.status
        node = Node(
            buses[0],
            buses[-1],
            corrector,
            period_s=status.period_s if status is not None else _DEFAULT_PERIOD_S,
            on_tick=tick,
            latency=latency,
            routed=routes is not None,
        )
        gc.collect()  # then freeze: later collections leave out what was made at the start
        gc.freeze()
        gc.set_threshold(_GARBAGE)
        node.run(stop, ready)
    return 0


def _store(
    options: argparse.Namespace, database: VehicleDatabase, mode: Mode, say: Callable[[str], None]
) -> "ParameterStore":
    from ecu_node.update.store import ParameterStore  # noqa: PLC0415  # imports this package

    now, background = partial(datetime.now, UTC), ThreadPoolExecutor(1, "state of the vehicle")
    return ParameterStore(
        options.state, database, mode=mode, say=say, now=now, vehicle=options.vehicle, background=background
    )


def _dry_run(buses: Sequence[Mapping[str, Any]], database: VehicleDatabase, mode: Mode) -> str:
    """Describe what a node on these buses would open, read and send."""
    near = buses[0]
    require_fd(database, mode, fd=near["fd"])
    written = _names(transmitted(database, mode))
    ways = [(_names(received(database)), "nothing" if near["listen_only"] else written)]
    if mode is Mode.GATEWAY:
        corrected, others = _names(rewritten(database)), "all other frames of the other bus, as they are"
        ways = [(f"all frames; corrects {corrected}", others)]
        ways.append(("all frames", f"{corrected}, corrected; {written}; {others}"))
    lines = []
    for bus, (reads, sends) in zip(buses, ways, strict=True):
        lines += [f"would open {config_text(bus_config(**bus))}", f"  reads {reads}", f"  sends {sends}"]
    if near["listen_only"]:
        lines.append(acknowledgement(near["interface"], near["channel"]))
    return "\n".join(lines)


def _names(messages: Mapping[FrameKey, Message]) -> str:
    return ", ".join(f"{message.name} (0x{key.identifier:X})" for key, message in messages.items()) or "nothing"


def _notes(options: argparse.Namespace, why_not: str | None) -> Iterator[str]:
    """Yield lines for the log at the start: what to know about the parameters and the buses."""
    if options.params is not None:
        yield "parameters are used that nobody signed (--unsigned)"
    if why_not is not None:
        yield f"passing measured values through: {why_not}"
    elif options.params is not None and options.vehicle is None:
        yield "the vehicle is not checked: give --vehicle or $ECU_NODE_VEHICLE"
    names = [options.channel, options.gateway] if options.gateway is not None and not options.fd else []
    if unseen := [name for name in names if carries_fd(options.interface, name)]:
        yield f"{' and '.join(unseen)}: set up for CAN FD, of which nothing is passed on without --fd"
    if options.listen_only:
        yield acknowledgement(options.interface, options.channel)


def check_report(params: Path, layout: Path, vehicle: str | None, *, is_gateway: bool = False) -> dict[str, Any]:
    """Check parameters against layout, DBC and vehicle.

    Parameters
    ----------
    params, layout : Path
        Parameter file and layout.
    vehicle : str or None
        Identity of the vehicle; None: not checked.
    is_gateway : bool
        Whether corrected values are written in place; else under identifiers of their own.

    Returns
    -------
    dict
        ``fit`` [bool], ``reason`` (as named in the status message), ``message`` (why not, or None), ``vehicle``,
        ``parameter_set``, ``warnings`` (texts), and ``branches``: per branch drift [1], offset_a [A] and apply, as the
        file says (0 and None where it does not name the branch), applied (whether it is corrected), target, and plan: a
        dict with gain, voltage_gain, bias and shift; None where the branch is not written.

    Raises
    ------
    LayoutError, DatabaseError
        If layout or DBC cannot be used at all, so that ``ecu-node run`` would fail, too.
    """
    mode = Mode.GATEWAY if is_gateway else Mode.OVERLAY
    database = node_database(layout)
    in_force = choose_parameters(params, database, vehicle)
    wire(database, in_force, start_s=0.0, mode=mode)
    warnings = [*unpublished(database, in_force, mode).values(), *narrowed(database, mode), *unsealed(database, mode)]
    if names := needs_fd(database, mode):
        warnings.append(f"CAN FD messages ({', '.join(names)}): 'ecu-node run' needs --fd")
    parameters = in_force.parameters
    return {
        "fit": in_force.why_not is None,
        "reason": in_force.reason.name,
        "message": in_force.why_not,
        "vehicle": parameters.vehicle if parameters is not None else None,
        "parameter_set": parameters.number if parameters is not None else None,
        "warnings": warnings,
        "branches": {branch.name: _branch(database, branch, in_force, mode) for branch in database.layout.branch},
    }


def _branch(database: VehicleDatabase, branch: Branch, in_force: InForce, mode: Mode) -> dict[str, Any]:
    said = in_force.parameters.branches.get(branch.name) if in_force.parameters is not None else None
    fault, target = in_force.fault(branch.name), branch.corrected if mode is Mode.OVERLAY else branch.source
    plan = branch_plan(database, branch, fault, mode) if target is not None else None
    return {
        "drift": said.drift if said is not None else 0.0,
        "offset_a": said.offset_a if said is not None else 0.0,
        "apply": said.apply if said is not None else None,
        "applied": fault.applied,
        "target": target,
        "plan": plan and {name: getattr(plan, name) for name in ("gain", "voltage_gain", "bias", "shift")},
    }


def report_text(report: dict[str, Any]) -> str:
    """Show a report of :func:`check_report` as text."""
    head = f"vehicle {report['vehicle']}, parameter set {report['parameter_set']}: fit"
    lines = [printable(head if report["fit"] else f"NOT FIT ({report['reason']}): {report['message']}")]
    width = max(map(len, ["branch", *report["branches"]]))
    lines.append(f"{'branch':<{width}}{'drift':>11}{'offset':>13}")
    for name, branch in report["branches"].items():
        is_written = branch["target"] is not None
        mark = "not published" if not is_written else "corrected" if branch["applied"] else "passed through"
        if branch["apply"] is False and (branch["drift"] or branch["offset_a"]):
            mark += ', "apply" is false'
        lines.append(f"{name:<{width}}{branch['drift']:>+11.4%}{branch['offset_a']:>+11.3f} A  {mark}")
        lines += [f"  target {branch['target']}"] if is_written else []
        if is_written and branch["applied"]:
            lines.append("  " + ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in branch["plan"].items()))
    lines += ["corrected code =", "  (code * gain + voltage code * voltage gain + bias + 2^(shift - 1)) >> shift"]
    return "\n".join([*lines, *(f"warning: {text}" for text in report["warnings"])])
