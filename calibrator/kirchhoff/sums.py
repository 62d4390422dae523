"""Kirchhoff's current law before and after correction, in figures.

For a current x(t) over the valid instants of the common time base of :mod:`calibrator.drives.align`:

    RMSE = sqrt(mean(x^2)),    maximum = max |x|,    mean,    sd = standard deviation

For the sum S of all branches the ideal is 0 A, or the load that layout or parameter file expect; its RMSE and maximum
are of the difference from this ideal. For a single branch nobody knows the ideal: its RMSE is the root mean square of
the current itself; what the correction did to it stands under *change*, the figures of (corrected - measured).

Right sensors do not sum to exactly 0 A either. The standard deviation that is expected of S at the instant t is

    sd(t)^2 = max(n^2, sum_k q_k^2 / 12) + sum_k (i_k'(t) T_k)^2 / 12 + (sum_k i_k'(t) tau_k)^2
              + sum_k (u_k i_k(t))^2 + L^2

with q_k the step of the signal of branch k, n the noise of S, estimated from its fast changes after gain errors and
delays are taken out (:func:`_noise`), T_k the period of the frames of branch k (a value is up to T_k old; 0 at instants
between frames that all branches have at the same times, as in a table), tau_k the delay of branch k as S shows it, u_k
the uncertainty of a formula that gives branch k, and L the spread of the declared load.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.align import align_channels, at_pace, step_seen
from calibrator.drives.delays import MAX_DELAY_S
from calibrator.errors import DriveError
from ecu_node.core.signals import VOLT, WATT, unit_factor
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from ecu_node.layout import Input
from ecu_node.parameters import VehicleParameters
from ecu_node.summary import DIFFERENCE_GAIN, MAD_TO_SD

__all__ = ["BAND", "SUM", "VOLTAGE", "Comparison", "compare_kirchhoff", "step_of", "with_voltages"]

VOLTAGE = "_junction_voltage"
"""Input that is the battery's voltage; drives may lack it."""
SUM = "sum"
"""Name of the sum in tables of the branches."""
BAND = 2.0
"""Half width of the band, in standard deviations: 19 of 20 instants of right sensors lie in it. [1]"""
MOVES = 5.0
"""A branch whose variation is less than this many times its noise gets no share in the sum. [1]"""
FEWEST = 50
"""Fewest valid instants from which the sum is divided into shares."""
_AFTER = " (corrected)"
"""End of the name of a corrected current beside the measured one."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Branch currents on one time base, as measured and as corrected.

    Attributes
    ----------
    full_scale_a : float
        Full scale of the junction. [A]
    parameters_of : str or None
        Vehicle whose parameters made the corrected currents; None if these are from frames, or there are none.
    left_out : tuple of str
        Branches of the layout without usable values: not in the sum.
    uncorrected : tuple of str
        Branches that are not corrected, and enter the corrected sum with measured values; empty if there is no
        corrected sum.
    masked : mapping of str to int
        Number of instants that are not valid, by reason; one may have several.
    stages : mapping of str to DataFrame of shape (T, K + 1)
        ``before`` and, if something is corrected, ``after``: a column per branch and :data:`SUM`, positive into the
        junction, by the instant [s]; NaN where not valid. [A]
    expected_a : float
        Sum that right sensors show: the load that the parameters expect or the layout declares, or 0. [A]
    expected_sd_a : ndarray of shape (T,)
        Standard deviation expected of the sum at each instant, see the top of this module. [A]
    parts_a : mapping of str to float
        Median of each part of this deviation: ``quantisation``, ``noise``, ``sampling``, ``delays``, ``formulas``,
        ``load``. [A]
    residual : mapping of str to dict, or None
        By stage, the shares in the mean square of the sum about its expected value, which add up to 1: ``constant``,
        its mean; ``gains``, what gain errors explain of the variation about the mean; ``delays``, what delays explain
        of what is then left; ``rest``. ``rest_a`` is the root mean square of the rest [A]. ``alone`` has for each
        branch the ``gain_error`` that it would have if its gain alone were wrong, and ``gain_share``, the share of the
        sum's variation that this explains; branches that move too little are absent. None if the instants are few or
        the sum is exact.
    """

    full_scale_a: float
    parameters_of: str | None
    left_out: tuple[str, ...]
    uncorrected: tuple[str, ...]
    masked: Mapping[str, int]
    stages: Mapping[str, pd.DataFrame]
    expected_a: float
    expected_sd_a: Array
    parts_a: Mapping[str, float]
    residual: Mapping[str, dict[str, Any] | None]

    @property
    def branches(self) -> tuple[str, ...]:
        """The K branches in the sum."""
        return tuple(self.stages["before"].columns[:-1])

    @property
    def valid(self) -> Mask:
        """Instants that the figures use, shape (T,)."""
        return np.asarray(self.stages["before"][SUM].notna())

    @property
    def figures(self) -> dict[str, pd.DataFrame]:
        """Rows for the branches and the sum, columns ``rmse_a``, ``max_a``, ``mean_a``, ``sd_a``, by stage. [A]

        The stages are ``before``, and ``after`` and ``change`` if something is corrected.
        """
        found = {stage: _figures(frame, self.expected_a) for stage, frame in self.stages.items()}
        if "after" in found:
            found["change"] = _figures(self.stages["after"] - self.stages["before"], 0.0)
        return found

    @property
    def usual_sd_a(self) -> float:
        """Standard deviation that is expected of the sum, in the median over the valid instants. [A]"""
        return float(np.median(self.expected_sd_a[self.valid]))

    @property
    def in_band(self) -> dict[str, float]:
        """By stage, the share of the valid instants at which the sum is within :data:`BAND` of what is expected. [1]"""
        far_a = (BAND * self.expected_sd_a + 1e-9 * self.full_scale_a)[self.valid]  # rounding
        sums_a = {stage: frame[SUM].to_numpy()[self.valid] for stage, frame in self.stages.items()}
        return {stage: float(np.mean(np.abs(sum_a - self.expected_a) <= far_a)) for stage, sum_a in sums_a.items()}

    def notices(self) -> list[str]:
        """Return short texts on what a reader of the figures must know."""
        unused, reasons = int(np.sum(~self.valid)), (f"{n:,} {reason}" for reason, n in self.masked.items() if n)
        texts = {
            f"no usable frames of {', '.join(self.left_out)}: left out of the sum": self.left_out,
            f"no correction of {', '.join(self.uncorrected)}: summed up as measured": self.uncorrected,
            f"corrected with the parameters of {self.parameters_of}": self.parameters_of,  # a log says no vehicle
            "no corrected frames: only measured currents": "after" not in self.stages,
            f"{unused:,} of {len(self.valid):,} instants not used: {', '.join(reasons)}": unused,
        }
        return [text for text, is_said in texts.items() if is_said]

    def as_json(self) -> dict[str, object]:
        """Return everything but the samples, with figures in A and in percent of full scale."""
        found: dict[str, Any] = dict.fromkeys(("before", "after", "change"))
        for stage, table in self.figures.items():
            percent = (table * (100.0 / self.full_scale_a)).rename(columns=lambda key: f"{key[:-2]}_percent")
            found[stage] = table.join(percent).to_dict("index")
        names = ("full_scale_a", "branches", "left_out", "uncorrected", "masked", "residual")
        expected = {"mean_a": self.expected_a, "sd_a": self.usual_sd_a}
        return {name: getattr(self, name) for name in names} | {
            **found,
            "instants": len(self.valid),
            "valid": int(self.valid.sum()),
            "expected": {**expected, "parts_a": self.parts_a, "in_band": self.in_band},
        }


def _figures(a: pd.DataFrame, expected_a: float) -> pd.DataFrame:
    error_a = a.assign(**{SUM: a[SUM] - expected_a})
    rmse_a, max_a = np.sqrt((error_a**2).mean()), error_a.abs().max()
    return pd.DataFrame({"rmse_a": rmse_a, "max_a": max_a, "mean_a": a.mean(), "sd_a": a.std(ddof=0)})


def _noise(value: Array) -> float:
    """Estimate the standard deviation of white noise from the fast changes of values, shape (n,), in their unit.

    It is 1.4826 / sqrt(20) times the median magnitude of third differences, in which smooth changes and rare jumps drop
    out; 0 where most values repeat the one before.
    """
    return float(MAD_TO_SD / np.sqrt(DIFFERENCE_GAIN) * np.median(np.abs(np.diff(value, 3)))) if len(value) > 3 else 0.0


def with_voltages(database: VehicleDatabase) -> VehicleDatabase:
    """Return the database with more inputs: :data:`VOLTAGE`, and the voltages of branches that are powers.

    The latter are for :func:`step_of`. :data:`VOLTAGE` is the first signal by which powers are divided, or else the
    first input in volts.
    """
    layout = database.layout
    volts = [item.signal for item in layout.input if database.signal(item.signal)[1].unit == "V"]
    divisors = {f"_voltage_{item.name}": item.voltage for item in layout.branch if item.voltage}
    for signal in [*divisors.values(), *volts][:1]:
        divisors[VOLTAGE] = signal
    more = [Input(name=name, signal=signal) for name, signal in divisors.items()]
    return replace(database, layout=msgspec.structs.replace(layout, input=[*layout.input, *more]))


def step_of(database: VehicleDatabase, name: str, drive: Drive) -> float:
    """Return the step in which the current of a branch was measured; 0 if it is not known. [A]

    It is the least distance of two values seen; where few values were seen, the scale of its signal. For a power it is
    the scale of the power over the median voltage, if the voltage is recorded.
    """
    branch, channel = database.layout.find_branch(name), drive.branches[name]
    if branch.power is not None and branch.voltage is not None:
        signal, voltage = database.signal(branch.power)[1], drive.inputs.get(f"_voltage_{name}")
        if signal.is_float or voltage is None:
            return 0.0
        volts = np.median(np.abs(voltage.value[voltage.good]))
        per_volt = unit_factor(signal, WATT, name) / unit_factor(database.signal(branch.voltage)[1], VOLT, name)
        return float(abs(float(signal.scale)) * per_volt / volts)
    return step_seen(channel, database.current_step_a(name))


def compare_kirchhoff(
    drive: Drive,
    database: VehicleDatabase,
    corrected: Mapping[str, Channel] | None = None,
    parameters: VehicleParameters | None = None,
) -> Comparison:
    """Return measured and corrected currents of a recording on one time base, no finer than its frames.

    Parameters
    ----------
    drive : Drive
        Measured currents.
    database : VehicleDatabase
        DBC and layout: period, limits, full scale, declared load, steps of the signals.
    corrected : mapping of str to Channel or None
        Corrected currents in the same recording, by branch, positive into the junction. [A]
    parameters : VehicleParameters or None
        Corrections to apply instead of `corrected`, as the node would: i = (i_m - offset) / (1 + drift).

    Raises
    ------
    LayoutError
        If a branch has the name of the sum.
    DriveError
        If fewer than two branches have usable values, no instant is valid for all of them, or the parameters are of
        other branches.
    """
    layout, where = at_pace(database.layout, [drive]), f"vehicle {drive.vehicle}, drive {drive.name}"
    usable = {name: channel for name, channel in drive.branches.items() if channel.good.any()}
    names = [name for name in layout.branch_names if name in usable]
    if SUM in names:
        raise LayoutError(f"{layout.path}: branch {SUM!r} is called like the sum of all branches; give it another name")
    if len(names) < 2:
        what = f"usable frames of {', '.join(names)} only" if names else "no branch has usable frames"
        raise DriveError(f"{where}: {what}; a sum needs two branches")
    found = {} if parameters is not None or corrected is None else corrected
    beside = {f"{name}{_AFTER}": found[name] for name in names if name in found and found[name].good.any()}
    limits_s = {f"{branch.name}{end}": branch.timeout_s for branch in layout.branch for end in ("", _AFTER)}
    time_s, values, reasons = align_channels(usable | beside, limits_s, period_s=layout.period_s, where=where)
    valid = ~np.any(list(reasons.values()), axis=0)
    if not valid.any():
        raise DriveError(f"{where}: no instant at which all of {', '.join(names)} are fresh; check timeout_s")
    if parameters is not None and not set(names) & parameters.branches.keys():
        raise DriveError(
            f"parameters of vehicle {parameters.vehicle}: they are of {', '.join(parameters.branches)}, and the sum "
            f"has {', '.join(names)}; give those of this junction"
        )
    after = {name: values[f"{name}{_AFTER}"] for name in names if f"{name}{_AFTER}" in beside}
    for name, fault in parameters.branches.items() if parameters is not None else ():
        if name in names and fault.apply:
            after[name] = (values[name] - fault.offset_a) / (1.0 + fault.drift)
    before = {name: values[name] for name in names}
    stages = {"before": before} | ({"after": before | after} if after or parameters is not None else {})
    frames = {stage: pd.DataFrame(each, index=pd.Index(time_s, name="time_s")) for stage, each in stages.items()}
    load = layout.unmeasured_load
    expected_a = (parameters.junction_residual.expected_a if parameters else 0.0) or (load.mean_a if load else 0.0)
    sd_a, parts_a, residual = _explained(frames, valid, database, drive, expected_a)
    for frame in frames.values():
        frame[SUM] = frame.sum(axis=1)
        frame[~valid] = np.nan
    return Comparison(
        full_scale_a=layout.full_scale_a,
        parameters_of=parameters.vehicle if parameters is not None else None,
        left_out=tuple(name for name in layout.branch_names if name not in names),
        uncorrected=tuple(name for name in names if name not in after) if "after" in frames else (),
        masked={reason: int(mask.sum()) for reason, mask in reasons.items()},
        stages=frames,
        expected_a=expected_a,
        expected_sd_a=sd_a,
        parts_a=parts_a,
        residual=residual,
    )


def _explained(
    frames: Mapping[str, pd.DataFrame], valid: Mask, database: VehicleDatabase, drive: Drive, expected_a: float
) -> tuple[Array, dict[str, float], dict[str, dict[str, Any] | None]]:
    """Return ``expected_sd_a``, ``parts_a`` and ``residual`` of a :class:`Comparison`."""
    time_s, measured_a = frames["before"].index.to_numpy(), frames["before"].to_numpy()
    channels = {name: drive.branches[name] for name in frames["before"]}
    good_s = [channel.time_s[channel.good] for channel in channels.values()]
    load, formulas = database.layout.unmeasured_load, [database.layout.find_branch(k).uncertainty for k in channels]
    slope = np.gradient(measured_a, time_s, axis=0) if len(time_s) > 1 else np.zeros_like(measured_a)
    step_a = np.array([step_of(database, name, drive) for name in channels])
    noise_a = np.array([_noise(channel.value[channel.good]) for channel in channels.values()])
    # The noise of each branch is in the sum, so none has more than that. In rows seconds apart a current itself looks
    # like noise, the sum less so, and the sum without gain errors and delays does not.
    most_a = _noise(measured_a.sum(axis=1)[valid])
    for _ in range(2):
        noise_a = np.maximum(np.minimum(noise_a, most_a), step_a / np.sqrt(12.0))
        shares = {stage: _shares(frame[valid], slope[valid], noise_a, expected_a) for stage, frame in frames.items()}
        _, delay_s, left_a = shares["before"]
        most_a = min(most_a, _noise(left_a))
    period_s = np.array([np.median(np.diff(each_s)) if len(each_s) > 1 else 0.0 for each_s in good_s])
    parts = {
        "quantisation": np.sum(step_a**2) / 12.0,
        "noise": most_a**2,
        "sampling": ~_together(good_s, time_s) * (slope**2 @ period_s**2) / 12.0,
        "delays": (slope @ delay_s) ** 2,
        "formulas": measured_a**2 @ np.square(formulas),
        "load": load.sd_a**2 if load is not None else 0.0,
    }
    whole = {name: np.broadcast_to(part, time_s.shape) for name, part in parts.items()}
    parts_a = {name: float(np.median(np.sqrt(part[valid]))) for name, part in whole.items()}
    sd_a = np.sqrt(sum(parts.values()) - np.minimum(parts["quantisation"], parts["noise"]) + np.zeros(len(time_s)))
    return sd_a, parts_a, {stage: found for stage, (found, *_) in shares.items()}


def _together(good_s: Sequence[Array], time_s: Array) -> Mask:
    """Return the instants whose good frames before and after are at the same times in all channels, shape (T,)."""
    sides = []
    for each_s in good_s:
        known_s = np.concatenate([[-np.inf], each_s, [np.inf]])
        before = np.searchsorted(known_s, time_s + 1e-6, side="right") - 1  # 1 us: rounding
        sides.append(known_s[np.stack([before, np.searchsorted(known_s, time_s - 1e-6)])])
    return np.asarray(np.all([side == sides[0] for side in sides], axis=(0, 1)))


def _shares(
    currents_a: pd.DataFrame, slope: Array, noise_a: Array, mean_a: float
) -> tuple[dict[str, Any] | None, Array, Array]:
    """Return shares in the sum, delays relative to the most varying current (K,) [s], and the unexplained rest [A].

    The sum holds the noise of each branch, too: its variance is taken out of both sides of the regression on the gains.
    The most varying current is left out of the regressions, since an error of its gain cannot be told from the same
    error of all others.
    """
    a = currents_a.to_numpy()
    x, total = a - a.mean(axis=0), a.sum(axis=1) - mean_a
    power, s, delay_s = float(np.mean(total**2)), total - total.mean(), np.zeros(x.shape[1])
    if len(total) < FEWEST or power <= 0.0:
        return None, delay_s, s
    variance, covariance, change = x.var(axis=0), x.T @ s / len(s), slope - slope.mean(axis=0)
    moving = variance > MOVES**2 * noise_a**2
    alone = {}
    for k in np.flatnonzero(moving):
        gain = float((covariance[k] - noise_a[k] ** 2) / (variance[k] - noise_a[k] ** 2))
        error = gain / (1.0 - gain) if gain < 1.0 else np.inf
        alone[currents_a.columns[k]] = {"gain_error": error, "gain_share": _gone(s, s - gain * x[:, k])}
    others = np.flatnonzero(moving & (np.arange(len(moving)) != np.argmax(variance)))
    gram = x[:, others].T @ x[:, others] / len(s) - np.diag(noise_a[others] ** 2)
    straight = s - x[:, others] @ (np.linalg.pinv(gram) @ (covariance - noise_a**2)[others])
    late = -np.linalg.lstsq(change[:, others], straight, rcond=1e-6)[0]
    delay_s[others] = np.where(np.abs(late) < MAX_DELAY_S, late, 0.0)
    left = straight + change @ delay_s
    varying = float(np.mean(s**2)) / power
    gains = varying * _gone(s, straight)
    delays = (varying - gains) * _gone(straight, left)
    rest = max(varying - gains - delays, 0.0)
    constant, rest_a = float(np.mean(total)) ** 2 / power, float(np.sqrt(rest * power))
    found = {"constant": constant, "gains": gains, "delays": delays, "rest": rest, "rest_a": rest_a, "alone": alone}
    return found, delay_s, left


def _gone(before: Array, after: Array) -> float:
    """Return the share of a signal's power that is gone after a part of it was subtracted. [1]"""
    power = float(before @ before)
    return max(1.0 - float(after @ after) / power, 0.0) if power > 0.0 else 0.0
