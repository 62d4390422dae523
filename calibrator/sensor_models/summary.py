"""Second moments with the columns of the families: those of each current, and as instruments those of each input."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.sensor_models.families import FAMILIES, Family
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise

__all__ = ["SensorSummary", "summarise_sensors"]


@dataclass(frozen=True, kw_only=True)
class SensorSummary:
    """Drives of one vehicle, summarised so that its sensors can be found not linear.

    Attributes
    ----------
    summary : DriveSummary
        With extra columns: per family those of the K currents and of the M inputs.
    zero_a : ndarray of shape (K,)
        Currents that the sensors were taken to show at 0 A. [A]
    families : tuple of Family
        Whose columns there are.
    """

    summary: DriveSummary
    zero_a: Array
    families: tuple[Family, ...]

    @property
    def products(self) -> Array:
        """Products of (inputs, currents, 1, extra columns) with themselves, shape (B, Q, Q)."""
        moments, extra = self.summary.moments, self.summary.extra
        assert extra is not None
        wide = extra[:, :, : moments.shape[1]]
        return np.concatenate(
            [np.concatenate([moments, np.swapaxes(wide, 1, 2)], axis=2), extra],
            axis=1,
        )

    def current_columns(self, family: Family) -> list[int]:
        """Positions of a family's columns of the currents among those of :attr:`products`."""
        start = self._first(family)
        return [*range(start, start + self.summary.branches)]

    def input_columns(self, family: Family) -> list[int]:
        """Positions of a family's columns of the inputs."""
        start = self._first(family) + self.summary.branches
        return [*range(start, start + self.summary.inputs)]

    def _first(self, family: Family) -> int:
        width = self.summary.branches + self.summary.inputs
        return width + 1 + self.families.index(family) * width


def summarise_sensors(
    drives: Sequence[Samples], *, zero_a: Array, period_s: float, temperature: str | None = None
) -> SensorSummary:
    """Summarise the drives of one vehicle for the search for sensors that are not linear.

    Parameters
    ----------
    drives : sequence of Samples
        Aligned samples with the same branches and inputs.
    zero_a : ndarray of shape (K,)
        What the sensors show at 0 A: the offsets that were found with linear sensors will do. [A]
    period_s : float
        Distance of the samples. [s]
    temperature : str or None
        Name of the input that is the temperature of the sensors [degC]; it does not stay among the inputs. None: there
        is none, and no drift with temperature is looked for.

    Returns
    -------
    SensorSummary
        Of the vehicle.

    Raises
    ------
    DriveError
        If a drive has not the temperature, or no block has enough valid samples.
    """
    families = tuple(family for family in FAMILIES if temperature is not None or not family.needs_temperature)
    extra: list[Array] = []
    kept: list[Samples] = []
    for drive in drives:
        samples, temperature_c = _split(drive, temperature)
        x = np.concatenate([samples.currents_a - zero_a, samples.inputs], axis=1)
        extra.append(np.concatenate([family.column(x, temperature_c) for family in families], axis=1))
        kept.append(samples)
    summary = summarise(kept, period_s=period_s, extra=extra)
    return SensorSummary(summary=summary, zero_a=zero_a, families=families)


def _split(drive: Samples, temperature: str | None) -> tuple[Samples, Array]:
    """Samples without the temperature among their inputs, and the temperature. [degC]"""
    if temperature is None:
        return drive, np.zeros(len(drive.time_s))
    if temperature not in drive.input_names:
        raise DriveError(
            f"no input {temperature!r} among {', '.join(drive.input_names)}; align the drive with it, or look for no "
            f"drift with temperature"
        )
    place = drive.input_names.index(temperature)
    names = tuple(name for name in drive.input_names if name != temperature)
    return replace(drive, input_names=names, inputs=np.delete(drive.inputs, place, axis=1)), drive.inputs[:, place]
