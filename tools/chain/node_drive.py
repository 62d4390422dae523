"""One vehicle drives with its node: its frames go through the node, and what comes out is compared with the truth."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.artificial.simulate import Vehicle, vehicle_currents, vehicle_frames
from calibrator.artificial.trips import GroundTruth
from calibrator.drive import Array
from calibrator.random_streams import Purpose, random_stream
from calibrator.recordings.canlog import FrameSeries
from ecu_node.bus.wiring import Mode, branch_signals, key_of
from ecu_node.core.corrector import Corrector
from ecu_node.core.signals import Codes, FrameKey
from ecu_node.database import VehicleDatabase
from ecu_node.layout import split_signal

__all__ = ["BranchErrors", "BranchTrace", "NodeDrive", "drive_through"]

LEAST_DIFFERENCE_A = 0.02
"""Errors that differ by less are the same: rounding to the codes of the corrected signal. [A]"""
LOOK_EVERY_S = 0.1
"""As often the node looks at the junction. [s]"""


@dataclass(frozen=True, kw_only=True)
class BranchTrace:
    """A branch in each of its frames; positive into the junction.

    Attributes
    ----------
    time_s : ndarray of shape (n,)
        When its frame came. [s]
    true_a, measured_a, published_a : ndarray of shape (n,)
        What flowed when the sensor saw it, what the sensor said, what the node made of it. [A]
    """

    time_s: Array
    true_a: Array
    measured_a: Array
    published_a: Array

    def errors(self, since_s: float = 0.0) -> "BranchErrors":
        """Root mean square errors of means of one second, from a time on [s]; the sensor's noise apart."""
        part = (self.time_s >= since_s) & np.isfinite(self.published_a) & np.isfinite(self.measured_a)
        second = self.time_s[part].astype(int)

        def rms(values: Array) -> float:
            sums, counts = np.bincount(second, values[part] - self.true_a[part]), np.bincount(second)
            return float(np.sqrt(np.mean((sums[counts > 0] / counts[counts > 0]) ** 2)))

        return BranchErrors(measured_a=rms(self.measured_a), published_a=rms(self.published_a))


@dataclass(frozen=True, kw_only=True)
class BranchErrors:
    """Root mean square errors of a branch, as measured and as published. [A]"""

    measured_a: float
    published_a: float

    @property
    def is_worse(self) -> bool:
        """Whether what is published is worse, by more than the rounding to its codes."""
        return self.published_a > self.measured_a + LEAST_DIFFERENCE_A


@dataclass(frozen=True, kw_only=True)
class NodeDrive:
    """A drive that goes through a node, frame by frame.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout.
    vehicle : Vehicle
        Who drives.
    trip : GroundTruth
        What.
    seed : sequence of int
        Of the frames' chance.
    """

    database: VehicleDatabase
    vehicle: Vehicle
    trip: GroundTruth
    seed: Sequence[int]


def drive_through(drive: NodeDrive, corrector: Corrector, look: Callable[[float], None]) -> dict[str, BranchTrace]:
    """Let a node, as an overlay, see a drive.

    Parameters
    ----------
    drive : NodeDrive
        The drive.
    corrector : Corrector
        The node without its bus.
    look : callable
        Called with the time [s] after each look at the junction.

    Returns
    -------
    dict of str to BranchTrace
        By branch of the vehicle.
    """
    rng = random_stream(Purpose.FRAMES, *drive.seed)
    sent = {
        FrameKey(item.arbitration_id, item.extended): item
        for item in vehicle_frames(rng, drive.database, drive.vehicle, drive.trip)
    }
    sent = {key: item for key, item in sent.items() if key in corrector.sources}
    published: dict[FrameKey, list[bytes]] = {key: [] for key in sent}
    for time_s, key, payload in _in_order(sent):
        if payload is None:
            corrector.look(time_s)
            look(time_s)
            continue
        for target in corrector.sources[key].answer(bytearray(payload), time_s):
            published[key].append(bytes(target.data))
    return {name: _trace(drive, k, sent, published) for k, name in enumerate(drive.vehicle.branches)}


def _trace(
    drive: NodeDrive, k: int, sent: Mapping[FrameKey, FrameSeries], published: Mapping[FrameKey, Sequence[bytes]]
) -> BranchTrace:
    branch = drive.database.layout.find_branch(drive.vehicle.branches[k])
    message_name, _ = split_signal(branch.source)
    key = key_of(drive.database.message(message_name))
    signals = branch_signals(drive.database, branch, Mode.OVERLAY)
    time_s = sent[key].time_s
    seen_s = np.asarray(time_s - drive.vehicle.delay_s[k])
    return BranchTrace(
        time_s=time_s,
        true_a=np.interp(seen_s, drive.trip.time_s, vehicle_currents(drive.vehicle, drive.trip)[:, k]),
        measured_a=_currents(signals.source, branch.sign, [bytes(row) for row in sent[key].data]),
        published_a=_currents(signals.target, branch.sign, published[key]),
    )


def _currents(codes: Codes, sign: int, payloads: Sequence[bytes]) -> Array:
    """Currents into the junction in the frames of one message, NaN where there is none. [A]"""
    found = np.array([codes.place.extract(payload) for payload in payloads], dtype=float)
    good = np.array([codes.is_value(int(code)) for code in found])
    return np.asarray(np.where(good, sign * (float(codes.scale) * found + float(codes.offset)), np.nan))


def _in_order(sent: Mapping[FrameKey, FrameSeries]) -> Iterator[tuple[float, FrameKey, bytes | None]]:
    """All frames in the order of time, and looks at the junction between them, without a payload."""
    keys = list(sent)
    time_s = np.concatenate([sent[key].time_s for key in keys])
    which = np.concatenate([np.full(len(sent[key].time_s), k) for k, key in enumerate(keys)])
    row = np.concatenate([np.arange(len(sent[key].time_s)) for key in keys])
    look_s = LOOK_EVERY_S
    for place in np.argsort(time_s, kind="stable").tolist():
        now_s, key = float(time_s[place]), keys[which[place]]
        while look_s <= now_s:
            yield look_s, key, None
            look_s += LOOK_EVERY_S
        yield now_s, key, sent[key].data[row[place]].tobytes()
