"""Kirchhoff's current law before and after correction, in figures.

Of a current x(t) over the valid instants of the common time base of :mod:`calibrator.drives.align`:

    RMSE = sqrt(mean(x^2)),    maximum = max |x|,    mean,    sd = standard deviation

For the sum of all branches the ideal is 0 A, so its RMSE is an error. For a single branch nobody knows the ideal: its
RMSE is the root mean square of the current itself; what the correction did to it stands under *change*, the figures of
(corrected - measured).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from calibrator.drive import Array, Channel, Mask
from calibrator.drives.align import align_channels
from calibrator.errors import DriveError
from calibrator.recordings.readers import Recording
from ecu_node.layout import Layout

__all__ = ["SUM", "Comparison", "Figures", "compare_kirchhoff", "figures_of"]

SUM = "sum"
"""Name of the sum among the branches."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of one current.

    Attributes
    ----------
    rmse_a, max_a, mean_a, sd_a : float
        Root mean square, largest magnitude, mean and standard deviation. [A]
    """

    rmse_a: float
    max_a: float
    mean_a: float
    sd_a: float

    def as_json(self, full_scale_a: float) -> dict[str, float]:
        """Figures in A and in percent of full scale."""
        amperes = asdict(self)
        return amperes | {
            f"{key.removesuffix('_a')}_percent": 100.0 * value / full_scale_a for key, value in amperes.items()
        }


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Measured and corrected branch currents on one time base.

    Attributes
    ----------
    full_scale_a : float
        Full scale of the junction. [A]
    branches : tuple of str
        The K branches in the sum.
    left_out : tuple of str
        Branches of the layout without usable frames: not in the sum.
    uncorrected : tuple of str
        Branches of the sum without corrected frames, which enter the sum after with their measured values; empty if
        nothing was corrected.
    time_s : ndarray of shape (T,)
        Instants. [s]
    measured_a : ndarray of shape (T, K)
        Measured currents, positive into the junction. [A]
    corrected_a : ndarray of shape (T, K) or None
        Corrected currents; None if there are no corrected frames. [A]
    valid : ndarray of bool, shape (T,)
        Instants that the figures use.
    masked : mapping of str to int
        How many instants are not valid for which reason.
    """

    full_scale_a: float
    branches: tuple[str, ...]
    left_out: tuple[str, ...]
    uncorrected: tuple[str, ...]
    time_s: Array
    measured_a: Array
    corrected_a: Array | None
    valid: Mask
    masked: Mapping[str, int]

    @property
    def before(self) -> dict[str, Figures]:
        """Figures of the measured currents by branch, and of their sum."""
        return self._table(self.measured_a)

    @property
    def after(self) -> dict[str, Figures] | None:
        """Figures of the corrected currents, None if there are none."""
        return None if self.corrected_a is None else self._table(self.corrected_a)

    @property
    def change(self) -> dict[str, Figures] | None:
        """Figures of corrected minus measured, None if nothing is corrected."""
        return None if self.corrected_a is None else self._table(self.corrected_a - self.measured_a)

    def notices(self) -> list[str]:
        """Return what a reader of the figures must know, one short text each."""
        texts = [f"no usable frames of {', '.join(self.left_out)}: left out of the sum"] if self.left_out else []
        if self.uncorrected:
            texts.append(f"no corrected frames of {', '.join(self.uncorrected)}: the sum after has measured values")
        if self.corrected_a is None:
            texts.append("no corrected frames: only the figures before")
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.masked.items() if count)
        texts += [f"{np.sum(~self.valid)} of {len(self.valid)} instants not used: {reasons}"] if reasons else []
        return texts

    def as_json(self) -> dict[str, object]:
        """Everything but the samples, with figures in A and in percent of full scale."""

        def table(figures: dict[str, Figures] | None) -> dict[str, dict[str, float]] | None:
            if figures is None:
                return None
            return {name: item.as_json(self.full_scale_a) for name, item in figures.items()}

        return {
            "full_scale_a": self.full_scale_a,
            "branches": list(self.branches),
            "left_out": list(self.left_out),
            "uncorrected": list(self.uncorrected),
            "instants": len(self.valid),
            "valid": int(self.valid.sum()),
            "masked": dict(self.masked),
            "before": table(self.before),
            "after": table(self.after),
            "change": table(self.change),
        }

    def _table(self, currents_a: Array) -> dict[str, Figures]:
        used = currents_a[self.valid]
        columns = {name: figures_of(used[:, k]) for k, name in enumerate(self.branches)}
        return columns | {SUM: figures_of(used.sum(axis=1))}


def figures_of(current_a: Array) -> Figures:
    """Figures of one current.

    Parameters
    ----------
    current_a : ndarray of shape (n,)
        The current, n > 0. [A]

    Returns
    -------
    Figures
        Root mean square, largest magnitude, mean and standard deviation (of the n values, not n - 1).
    """
    return Figures(
        rmse_a=float(np.sqrt(np.mean(current_a**2))),
        max_a=float(np.max(np.abs(current_a))),
        mean_a=float(np.mean(current_a)),
        sd_a=float(np.std(current_a)),
    )


def compare_kirchhoff(recording: Recording, layout: Layout) -> Comparison:
    """Put measured and corrected currents of a recording on one time base.

    Parameters
    ----------
    recording : Recording
        A drive, with the corrected currents found beside it.
    layout : Layout
        Says period, limits and full scale.

    Returns
    -------
    Comparison
        The currents, and from them the figures.

    Raises
    ------
    DriveError
        If fewer than two branches have usable frames, or no instant is valid for all of them.
    """
    drive = recording.drive
    where = f"vehicle {drive.vehicle}, drive {drive.name}"
    measured = _usable(drive.branches)
    corrected = {name: channel for name, channel in _usable(recording.corrected).items() if name in measured}
    names = tuple(name for name in layout.branch_names if name in measured)
    if len(names) < 2:
        raise DriveError(f"{where}: {_usable_text(names)}; a sum needs two branches")
    timeouts_s = {branch.name: branch.timeout_s for branch in layout.branch}
    channels = measured | {_after(name): channel for name, channel in corrected.items()}
    limits_s = {name: timeouts_s[name] for name in names} | {_after(name): timeouts_s[name] for name in corrected}
    time_s, values, reasons = align_channels(channels, limits_s, period_s=layout.period_s, where=where)
    valid = ~np.any(list(reasons.values()), axis=0)
    if not valid.any():
        raise DriveError(f"{where}: no instant at which all of {', '.join(names)} are fresh; check timeout_s")
    after = [values[_after(name)] if name in corrected else values[name] for name in names]
    return Comparison(
        full_scale_a=layout.full_scale_a,
        branches=names,
        left_out=tuple(name for name in layout.branch_names if name not in names),
        uncorrected=tuple(name for name in names if name not in corrected) if corrected else (),
        time_s=time_s,
        measured_a=np.column_stack([values[name] for name in names]),
        corrected_a=np.column_stack(after) if corrected else None,
        valid=valid,
        masked={reason: int(mask.sum()) for reason, mask in reasons.items()},
    )


def _usable_text(names: Sequence[str]) -> str:
    return f"usable frames of {', '.join(names)} only" if names else "no branch has usable frames"


def _usable(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    return {name: channel for name, channel in channels.items() if channel.good.any()}


def _after(name: str) -> str:
    """Key of a corrected current; no branch can have such a name."""
    return f"{name} (corrected)"
