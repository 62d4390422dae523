"""The node's work as most programs would do it: cantools decodes the message, cantools encodes it again."""

from collections.abc import Callable
from typing import Any

from bench.node_vehicle import FAULTS, BenchVehicle
from ecu_node.bus.wiring import Mode
from ecu_node.core.e2e import Check, Protection, Receiver, protection_of
from ecu_node.core.status import Quality

__all__ = ["PlainJob", "plain_job"]

PlainJob = Callable[[bytearray], bytearray | None]
"""Takes the payload of a frame and makes the one to send; None if the frame is not used."""

_USABLE = frozenset({Check.OK, Check.LOST})
_BATTERY_DRIFT, _BATTERY_OFFSET_A = FAULTS["battery"]
_MOTOR_DRIFT, _MOTOR_OFFSET_A = FAULTS["motor"]


def plain_job(vehicle: BenchVehicle, mode: Mode) -> PlainJob:
    """The work of one mode, with the node's own end-to-end protection.

    Parameters
    ----------
    vehicle : BenchVehicle
        Whose currents are corrected.
    mode : Mode
        In a gateway the message is rewritten; else another one is filled.

    Returns
    -------
    callable
        The work of one frame.
    """
    database = vehicle.database
    message, answer = database.message("Pair"), database.message("PairOut")
    check = Receiver(_protection(vehicle, "Pair")).check
    seal, advance = _protection(vehicle, "Pair").seal, _protection(vehicle, "PairOut").advance

    def corrected(payload: bytearray) -> dict[str, Any]:
        values: dict[str, Any] = message.decode(payload)  # type: ignore[arg-type, assignment]
        values["Battery"] = (values["Battery"] - _BATTERY_OFFSET_A) / (1.0 + _BATTERY_DRIFT)
        values["Motor"] = -(-values["Motor"] - _MOTOR_OFFSET_A) / (1.0 + _MOTOR_DRIFT)
        return values

    def rewrite(payload: bytearray) -> bytearray | None:
        if check(payload) not in _USABLE:
            return None
        out = bytearray(message.encode(corrected(payload)))
        seal(out)
        return out

    counter = -1

    def fill(payload: bytearray) -> bytearray | None:
        nonlocal counter
        if check(payload) not in _USABLE:
            return None
        values = corrected(payload)
        out = bytearray(
            answer.encode(
                {
                    "Crc": 0,
                    "Counter": counter % 15,
                    "Battery": values["Battery"],
                    "Motor": values["Motor"],
                    "Quality": int(Quality.CORRECTED),
                }
            )
        )
        advance(out)
        counter += 1
        return out

    return rewrite if mode is Mode.GATEWAY else fill


def _protection(vehicle: BenchVehicle, name: str) -> Protection:
    found = protection_of(vehicle.database, vehicle.database.message(name))
    assert found is not None
    return found
