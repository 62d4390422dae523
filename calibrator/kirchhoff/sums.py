"""Kirchhoff's current law before and after correction, in figures.

Of a current x(t) over the valid instants of the common time base of :mod:`calibrator.drives.align`:

    RMSE = sqrt(mean(x^2)),    maximum = max |x|,    mean,    sd = standard deviation

For the sum S of all branches the ideal is 0 A (or the declared load), so its RMSE is an error. For a single branch
nobody knows the ideal: its RMSE is the root mean square of the current itself; what the correction did to it stands
under *change*, the figures of (corrected - measured).

Right sensors do not sum to exactly 0 A either. The standard deviation that is expected of S at the instant t is

    sd(t)^2 = max(n^2, sum_k q_k^2 / 12) + sum_k (i_k'(t) T_k)^2 / 12 + (sum_k i_k'(t) tau_k)^2
              + sum_k (u_k i_k(t))^2 + L^2

with q_k the step of the signal of branch k, n the noise of S as fast changes of what gains and delays leave of it show
it (:func:`_noise`), T_k the period of the frames of branch k (a value is up to T_k old; 0 at instants between frames
that all branches have at the same times, as in a table), tau_k the delay of branch k as S shows it, u_k the uncertainty
of a formula that gives branch k, and L the spread of the declared load.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec
import numpy as np

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.align import align_channels
from calibrator.drives.delays import MAX_DELAY_S
from calibrator.errors import DriveError
from ecu_node.core.signals import VOLT, WATT, unit_factor
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Input
from ecu_node.parameters import VehicleParameters

__all__ = [
    "BAND",
    "SUM",
    "VOLTAGE",
    "Comparison",
    "compare_kirchhoff",
    "junction_voltage",
    "sensor_of",
    "with_voltages",
]

VOLTAGE = "_junction_voltage"
"""Input that is the battery's voltage; drives may lack it."""
SUM = "sum"
"""Name of the sum among the branches."""
BAND = 2.0
"""Half width of the band, in standard deviations: 19 of 20 instants of right sensors lie in it. [1]"""
MOVES = 5.0
"""A branch whose variation is less than this many times its noise has no share that could be told. [1]"""
LEVELS = 10
"""Fewer different values do not show a step: a heater is on or off. [1]"""
FEWEST = 50
"""Valid instants, to divide the sum into shares."""


class Figures(NamedTuple):
    """Root mean square, largest magnitude, mean and standard deviation of one current. [A]"""

    rmse_a: float
    max_a: float
    mean_a: float
    sd_a: float


class Sensor(NamedTuple):
    """What is known of one branch without any other: step and white noise [A], and the period of its frames [s]."""

    step_a: float
    noise_a: float
    period_s: float


@dataclass(frozen=True)
class GainAlone:
    """Gain error of a branch that the sum asks for, and the share of the sum's variation that it explains. [1]"""

    gain_error: float
    gain_share: float


@dataclass(frozen=True, kw_only=True)
class Residual:
    """Shares in the mean square of the sum about what is expected.

    Attributes
    ----------
    constant, gains, delays, rest : float
        Of its mean; of what gain errors of the branches explain about the mean; of what delays explain of the rest; and
        of what remains. They add up to 1. [1]
    rest_a : float
        Root mean square of what remains. [A]
    alone : mapping of str to GainAlone
        By branch, as if its gain alone were wrong. Branches that move too little to tell are absent.
    """

    constant: float
    gains: float
    delays: float
    rest: float
    rest_a: float
    alone: Mapping[str, GainAlone]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Branch currents on one time base, as measured and as corrected.

    Attributes
    ----------
    full_scale_a : float
        Full scale of the junction. [A]
    branches : tuple of str
        The K branches in the sum.
    left_out : tuple of str
        Branches of the layout without usable values: not in the sum.
    uncorrected : tuple of str
        Branches that are not corrected, and enter the sum after with their measured values; empty without a sum after.
    time_s : ndarray of shape (T,)
        Instants. [s]
    valid : ndarray of bool, shape (T,)
        Instants that the figures use.
    masked : mapping of str to int
        How many instants are not valid for which reason.
    currents_a : mapping of str to ndarray of shape (T, K)
        Currents ``before`` and, if something is corrected, ``after``, positive into the junction. [A]
    expected_a : float
        Sum that right sensors show: the declared load, or 0. [A]
    expected_sd_a : ndarray of shape (T,)
        Its standard deviation at each instant, see the top of this module. [A]
    parts_a : mapping of str to float
        Each part of that in the median: ``quantisation``, ``noise``, ``sampling``, ``delays``, ``formulas``,
        ``load``. [A]
    residual : mapping of str to Residual or None
        Shares in the sum before and after; None of few instants, or of a sum that is exact.
    """

    full_scale_a: float
    branches: tuple[str, ...]
    left_out: tuple[str, ...]
    uncorrected: tuple[str, ...]
    time_s: Array
    valid: Mask
    masked: Mapping[str, int]
    currents_a: Mapping[str, Array]
    expected_a: float
    expected_sd_a: Array
    parts_a: Mapping[str, float]
    residual: Mapping[str, Residual | None]

    @property
    def figures(self) -> dict[str, dict[str, Figures]]:
        """Figures ``before``, and ``after`` and ``change`` if something is corrected, by branch and for the sum."""
        stages = {stage: current_a[self.valid] for stage, current_a in self.currents_a.items()}
        if "after" in stages:
            stages["change"] = stages["after"] - stages["before"]
        names = (*self.branches, SUM)
        return {
            stage: dict(zip(names, map(_figures, (*a.T, a.sum(axis=1))), strict=True)) for stage, a in stages.items()
        }

    @property
    def sums_a(self) -> dict[str, Array]:
        """Sum before and after, shape (T,) each; NaN where not valid. [A]"""
        return {stage: np.where(self.valid, a.sum(axis=1), np.nan) for stage, a in self.currents_a.items()}

    @property
    def usual_sd_a(self) -> float:
        """Standard deviation that is expected of the sum, in the median over the valid instants. [A]"""
        return float(np.median(self.expected_sd_a[self.valid]))

    @property
    def in_band(self) -> dict[str, float]:
        """Share of the valid instants at which the sum lies within :data:`BAND` of what is expected. [1]"""
        far_a = BAND * self.expected_sd_a + 1e-9 * self.full_scale_a  # rounding
        inside = {stage: np.abs(sum_a - self.expected_a) <= far_a for stage, sum_a in self.sums_a.items()}
        return {stage: float(np.mean(item[self.valid])) for stage, item in inside.items()}

    def notices(self) -> list[str]:
        """Return what a reader of the figures must know, one short text each."""
        texts = [f"no usable frames of {', '.join(self.left_out)}: left out of the sum"] if self.left_out else []
        if self.uncorrected:
            texts.append(f"no correction of {', '.join(self.uncorrected)}: the sum after has measured values")
        if "after" not in self.currents_a:
            texts.append("no corrected frames: only the figures before")
        reasons = ", ".join(f"{count:,} {reason}" for reason, count in self.masked.items() if count)
        texts += [f"{np.sum(~self.valid):,} of {len(self.valid):,} instants not used: {reasons}"] if reasons else []
        return texts

    def as_json(self) -> dict[str, object]:
        """Everything but the samples, with figures in A and in percent of full scale."""

        def both(found: dict[str, float]) -> dict[str, float]:
            percent = {f"{key[:-2]}_percent": 100.0 * value / self.full_scale_a for key, value in found.items()}
            return found | percent

        tables = {
            stage: {name: both(item._asdict()) for name, item in found.items()} for stage, found in self.figures.items()
        }
        names = ("full_scale_a", "branches", "left_out", "uncorrected", "masked")
        return {
            **{name: getattr(self, name) for name in names},
            "instants": len(self.valid),
            "valid": int(self.valid.sum()),
            **(dict.fromkeys(("before", "after", "change")) | tables),
            "expected": {
                "mean_a": self.expected_a,
                "sd_a": self.usual_sd_a,
                "parts_a": self.parts_a,
                "in_band": self.in_band,
            },
            "residual": self.residual,
        }


def _figures(a: Array) -> Figures:
    """Figures of one current of shape (n,), n > 0; the standard deviation is that of the n values, not n - 1. [A]"""
    rmse_a = float(np.sqrt(np.mean(a**2)))
    return Figures(rmse_a=rmse_a, max_a=float(np.abs(a).max()), mean_a=float(a.mean()), sd_a=float(a.std()))


def _noise(value: Array) -> float:
    """Standard deviation of white noise as fast changes show it, in the unit of the values, shape (n,).

    1.4826 / sqrt(20) times the median of the magnitudes of third differences: what changes smoothly drops out, and so
    do rare jumps; 0 where most values repeat the one before.
    """
    return float(1.4826 / np.sqrt(20.0) * np.median(np.abs(np.diff(value, 3)))) if len(value) > 3 else 0.0


def with_voltages(database: VehicleDatabase) -> VehicleDatabase:
    """The same with inputs more: voltages of branches that are powers, for :func:`sensor_of`, and :data:`VOLTAGE`."""
    layout, signal = database.layout, junction_voltage(database)
    more = [Input(name=f"_voltage_{item.name}", signal=item.voltage) for item in layout.branch if item.voltage]
    more += [Input(name=VOLTAGE, signal=signal)] if signal is not None else []
    return replace(database, layout=msgspec.structs.replace(layout, input=[*layout.input, *more]))


def junction_voltage(database: VehicleDatabase) -> str | None:
    """The signal that powers are divided by, or else the first input in volts."""
    layout = database.layout
    volts = [item.signal for item in layout.input if database.signal(item.signal)[1].unit == "V"]
    return next((item.voltage for item in layout.branch if item.voltage), volts[0] if volts else None)


def sensor_of(database: VehicleDatabase, name: str, drive: Drive) -> Sensor:
    """Step, noise and period of a branch.

    Its step is the least distance of two values seen, or the scale of its signal if that is less; of a power the scale
    of the power over the usual voltage, where that is recorded. Its noise is not less than that of the step.
    """
    branch, channel = database.layout.find_branch(name), drive.branches[name]
    time_s, value = channel.time_s[channel.good], channel.value[channel.good]
    levels_a = np.unique(np.round(value, 9))
    steps_a = [float(np.diff(levels_a).min())] if len(levels_a) >= LEVELS else []
    if branch.power is not None and branch.voltage is not None:
        signal, voltage = database.signal(branch.power)[1], drive.inputs.get(f"_voltage_{name}")
        volts = float(np.median(np.abs(voltage.value[voltage.good]))) if voltage is not None else np.inf
        volts *= unit_factor(database.signal(branch.voltage)[1], VOLT, name)
        steps_a = [] if signal.is_float else [abs(float(signal.scale)) * unit_factor(signal, WATT, name) / volts]
    elif scale_a := abs(database.current_step_a(name)):
        steps_a.append(scale_a)
    step_a = min(steps_a, default=0.0)
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    return Sensor(step_a=step_a, noise_a=max(_noise(value), step_a / np.sqrt(12.0)), period_s=period_s)


def compare_kirchhoff(
    drive: Drive,
    database: VehicleDatabase,
    corrected: Mapping[str, Channel] | None = None,
    parameters: VehicleParameters | None = None,
) -> Comparison:
    """Put measured and corrected currents of a recording on one time base.

    Parameters
    ----------
    drive : Drive
        Measured currents.
    database : VehicleDatabase
        DBC and layout: period, limits, full scale, declared load, steps of the signals.
    corrected : mapping of str to Channel or None
        Corrected currents that were found beside the measured ones, positive into the junction. [A]
    parameters : VehicleParameters or None
        Corrections to apply here instead, i = (i_m - offset) / (1 + drift), as the node would.

    Returns
    -------
    Comparison
        The currents, and from them the figures.

    Raises
    ------
    DriveError
        If fewer than two branches have usable values, no instant is valid for all of them, or the parameters are of
        other branches.
    """
    layout, where = database.layout, f"vehicle {drive.vehicle}, drive {drive.name}"
    measured = {name: channel for name, channel in drive.branches.items() if channel.good.any()}
    names = tuple(name for name in layout.branch_names if name in measured)
    if len(names) < 2:
        what = f"usable frames of {', '.join(names)} only" if names else "no branch has usable frames"
        raise DriveError(f"{where}: {what}; a sum needs two branches")
    found = {} if parameters is not None else corrected or {}
    beside = {f"{name} (corrected)": found[name] for name in names if name in found and found[name].good.any()}
    timeouts_s = {branch.name: branch.timeout_s for branch in layout.branch}
    limits_s = timeouts_s | {f"{name} (corrected)": limit_s for name, limit_s in timeouts_s.items()}
    time_s, values, reasons = align_channels(measured | beside, limits_s, period_s=layout.period_s, where=where)
    valid = ~np.any(list(reasons.values()), axis=0)
    if not valid.any():
        raise DriveError(f"{where}: no instant at which all of {', '.join(names)} are fresh; check timeout_s")
    if parameters is not None and not set(names) & parameters.branches.keys():
        raise DriveError(
            f"parameters of vehicle {parameters.vehicle}: they are of {', '.join(parameters.branches)}, and the sum "
            f"has {', '.join(names)}; give those of this junction"
        )
    after = {name: values[f"{name} (corrected)"] for name in names if f"{name} (corrected)" in beside}
    for name, fault in parameters.branches.items() if parameters is not None else ():
        if name in names and fault.apply:
            after[name] = (values[name] - fault.offset_a) / (1.0 + fault.drift)
    currents_a = {"before": np.column_stack([values[name] for name in names])}
    if after or parameters is not None:
        currents_a["after"] = np.column_stack([after.get(name, values[name]) for name in names])
    load = layout.unmeasured_load
    sd_a, parts_a, residual = _explained(currents_a, time_s, valid, database, drive)
    return Comparison(
        full_scale_a=layout.full_scale_a,
        branches=names,
        left_out=tuple(name for name in layout.branch_names if name not in names),
        uncorrected=tuple(name for name in names if name not in after) if "after" in currents_a else (),
        time_s=time_s,
        valid=valid,
        masked={reason: int(mask.sum()) for reason, mask in reasons.items()},
        currents_a=currents_a,
        expected_a=load.mean_a if load is not None else 0.0,
        expected_sd_a=sd_a,
        parts_a=parts_a,
        residual=residual,
    )


def _explained(
    currents_a: Mapping[str, Array], time_s: Array, valid: Mask, database: VehicleDatabase, drive: Drive
) -> tuple[Array, dict[str, float], dict[str, Residual | None]]:
    """Standard deviation of the sum by the formula at the top of this module, its parts, and the shares in the sum."""
    channels = {name: drive.branches[name] for name in database.layout.branch_names if name in drive.branches}
    sensors = {name: sensor_of(database, name, drive) for name, item in channels.items() if item.good.any()}
    load, measured_a = database.layout.unmeasured_load, currents_a["before"]
    mean_a, load_sd_a = (load.mean_a, load.sd_a) if load is not None else (0.0, 0.0)
    slope = np.gradient(measured_a, time_s, axis=0) if len(time_s) > 1 else np.zeros_like(measured_a)
    # The noise of each branch is in the sum. Of rows seconds apart a current itself looks like noise, the sum less so,
    # and what gain errors and delays leave of the sum does not.
    most_a = _noise(measured_a.sum(axis=1)[valid])
    for _ in range(2):
        sensors = {
            name: sensor._replace(noise_a=max(min(sensor.noise_a, most_a), sensor.step_a / np.sqrt(12.0)))
            for name, sensor in sensors.items()
        }
        shares = {name: _residual(a[valid], slope[valid], sensors, mean_a) for name, a in currents_a.items()}
        _, delay_s, left_a = shares["before"]
        most_a = min(most_a, _noise(left_a))
    together = _together([channels[name] for name in sensors], time_s)
    parts = {
        "quantisation": np.array(sum(sensor.step_a**2 for sensor in sensors.values()) / 12.0),
        "noise": np.array(most_a**2),
        "sampling": ~together * (slope**2 @ np.array([sensor.period_s**2 / 12.0 for sensor in sensors.values()])),
        "delays": (slope @ delay_s) ** 2,
        "formulas": (measured_a**2)
        @ np.array([database.layout.find_branch(name).uncertainty ** 2 for name in sensors]),
        "load": np.array(load_sd_a**2),
    }
    parts_a = {name: float(np.median(np.sqrt(part if part.ndim == 0 else part[valid]))) for name, part in parts.items()}
    sd_a = np.sqrt(sum(parts.values()) - np.minimum(parts["quantisation"], parts["noise"]))
    return sd_a, parts_a, {stage: residual for stage, (residual, *_) in shares.items()}


def _together(channels: Sequence[Channel], time_s: Array) -> Mask:
    """Instants between, or at, good frames that have the same times in all channels."""
    sides = []
    for channel in channels:
        good_s = np.concatenate([[-np.inf], channel.time_s[channel.good], [np.inf]])
        before = np.searchsorted(good_s, time_s + 1e-6, side="right") - 1  # 1 us: rounding
        sides.append(good_s[np.stack([before, np.searchsorted(good_s, time_s - 1e-6)])])
    return np.asarray(np.all([side == sides[0] for side in sides], axis=(0, 1)))


def _residual(
    currents_a: Array, slope: Array, sensors: Mapping[str, Sensor], mean_a: float
) -> tuple[Residual | None, Array, Array]:
    """Shares in the sum, the delays that it shows relative to the branch that moves most, shape (K,) [s], and the rest.

    The sum holds the noise of each branch, too: its variance is taken out of both sides of the regression on the gains.
    The branch that moves most is left out of the regressions, since all gains together cannot be told from its own.
    """
    x, total = currents_a - currents_a.mean(axis=0), currents_a.sum(axis=1) - mean_a
    power, s, delay_s = float(np.mean(total**2)), total - total.mean(), np.zeros(x.shape[1])
    if len(total) < FEWEST or power <= 0.0:
        return None, delay_s, s
    noise2 = np.array([sensor.noise_a**2 for sensor in sensors.values()])
    variance, covariance, change = x.var(axis=0), x.T @ s / len(s), slope - slope.mean(axis=0)
    moving = variance > MOVES**2 * noise2
    alone = {}
    for k, name in enumerate(sensors):
        if moving[k]:
            gain = float((covariance[k] - noise2[k]) / (variance[k] - noise2[k]))
            error = gain / (1.0 - gain) if gain < 1.0 else np.inf
            alone[name] = GainAlone(error, _gone(s, s - gain * x[:, k]))
    others = np.flatnonzero(moving & (np.arange(len(moving)) != np.argmax(variance)))
    gram = x[:, others].T @ x[:, others] / len(s) - np.diag(noise2[others])
    straight = s - x[:, others] @ (np.linalg.pinv(gram) @ (covariance - noise2)[others])
    late = -np.linalg.lstsq(change[:, others], straight, rcond=1e-6)[0]
    delay_s[others] = np.where(np.abs(late) < MAX_DELAY_S, late, 0.0)
    varying = float(np.mean(s**2)) / power
    gains = varying * _gone(s, straight)
    left = straight + change @ delay_s
    delays = (varying - gains) * _gone(straight, left)
    rest = max(varying - gains - delays, 0.0)
    constant, rest_a = float(np.mean(total)) ** 2 / power, float(np.sqrt(rest * power))
    residual = Residual(constant=constant, gains=gains, delays=delays, rest=rest, rest_a=rest_a, alone=alone)
    return residual, delay_s, left


def _gone(before: Array, after: Array) -> float:
    """Share of the power of a signal that is gone."""
    power = float(before @ before)
    return max(1.0 - float(after @ after) / power, 0.0) if power > 0.0 else 0.0
