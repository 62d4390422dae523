"""Filter bank: A and B of the state-space model (2) of [1]_, the same for all vehicles; C and D are per vehicle.

Columns of the bank are the inputs u themselves and, per pole p, each input filtered by x(t+1) = p x(t) + (1 - p) u(t).
This is a low-pass for a real pole, and a resonance for a complex one, whose real and imaginary part are two columns.
All columns depend on the inputs alone, so sensor noise leaves no bias in a read-out (output error).

Over invalid samples an input keeps its last valid value for a limited time. After a longer gap, and at the start of a
drive, the filters start in the steady state of the first valid input, and their output is not used until they have
settled, that is until only a small share of an error of that start remains. A bank without poles has nothing to
settle: its columns are the plain inputs. The filters run sample by sample in compiled code.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import hashlib
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import Array, Complex, Mask
from calibrator.errors import DriveError

__all__ = ["FilterBank", "low_passes", "read_bank"]

LONGEST_HOLD_S = 1.0
"""Longest time that an input may keep its last valid value; currents seldom change much within it. [s]"""
UNSETTLED = 0.05
"""Share of an error at the start that settled filters still have: after three time constants of the slowest. [1]"""
LARGEST_RADIUS = 1.0 - 1e-9
"""Largest magnitude of a pole; one any closer to the unit circle does not settle. [1]"""

Poles = tuple[tuple[float, float], ...]


class FilterBank(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Inputs and poles of the filters that all vehicles of a fleet share.

    Attributes
    ----------
    input_names : tuple of str
        Names of the M inputs.
    period_s : float
        Time between samples. [s]
    poles : tuple of (float, float)
        Real and imaginary part of each pole in the z-plane, inside the unit circle. A complex pair is given by its pole
        with positive imaginary part. Empty: the plain inputs.

    Raises
    ------
    DriveError
        If a pole is unstable or in the lower half plane, the period is not positive, or two inputs have one name.
    """

    input_names: tuple[str, ...]
    period_s: float
    poles: Poles = ()

    def __post_init__(self) -> None:
        """Check period, names and poles."""
        if not (np.isfinite(self.period_s) and self.period_s > 0.0):
            raise DriveError(f"filter bank: period {self.period_s} s; expected a positive number")
        if len(set(self.input_names)) < len(self.input_names):
            raise DriveError(f"filter bank: inputs {', '.join(self.input_names)}; expected distinct names")
        for real, imag in self.poles:
            if not (np.hypot(real, imag) <= LARGEST_RADIUS and imag >= 0.0):
                raise DriveError(
                    f"filter bank: pole {real:g} + {imag:g}i; expected one inside the unit circle, of a complex pair "
                    "that with positive imaginary part"
                )

    @property
    def identity(self) -> str:
        """Digest of input names, period and poles; summaries made with different banks must not be mixed."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]

    @property
    def complex_poles(self) -> Complex:
        """Poles, shape (m,)."""
        return np.array([complex(*pole) for pole in self.poles], np.complex128)

    @property
    def width(self) -> int:
        """Number of columns: the inputs, and one state of each for a real pole, two for a complex one."""
        return len(self.input_names) * (1 + sum(1 if imag == 0.0 else 2 for _, imag in self.poles))

    @property
    def settling(self) -> int:
        """Number of samples after a start that are not used, because the filters have not settled yet."""
        slowest = max((float(np.hypot(*pole)) for pole in self.poles), default=0.0)
        return int(np.ceil(np.log(UNSETTLED) / np.log(slowest))) if slowest > 0.0 else 0

    def run(self, inputs: Array, valid: Mask, *, settling: int = 0) -> tuple[Array, Mask]:
        """Filter the inputs of a drive.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs; finite where valid.
        valid : ndarray of bool of shape (T,)
            Samples that may be used.
        settling : int
            Least number of samples after a start that are not used, if larger than :attr:`settling`: that of a slower
            bank makes both banks comparable on the same samples.

        Returns
        -------
        columns : ndarray of shape (T, W)
            W = :attr:`width` columns, inputs and states; zero where not used.
        used : ndarray of bool of shape (T,)
            Valid samples at which the filters have settled.
        """
        columns, used = np.zeros((len(inputs), self.width)), np.zeros(len(inputs), np.bool_)
        real, pairs = _by_kind(self.complex_poles)
        samples = np.ascontiguousarray(inputs, np.float64), np.ascontiguousarray(valid)
        limits = np.array([round(LONGEST_HOLD_S / self.period_s), max(settling, self.settling)])
        _filter(samples, np.concatenate([real, pairs]), len(real), limits, (columns, used))
        return columns, used

    def to_json(self) -> bytes:
        """Return the content of a bank file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"

    def described(self) -> str:
        """Return the poles in words: time constant of each low-pass, frequency and time constant of each resonance."""
        words = [_described(pole, self.period_s) for pole in self.complex_poles]
        return ", ".join(words) or "the plain inputs"


def low_passes(time_constants_s: Array, *, period_s: float) -> Poles:
    """Return the poles of first-order low-passes.

    Parameters
    ----------
    time_constants_s : ndarray of shape (m,)
        Time constants. [s]
    period_s : float
        Time between samples. [s]

    Returns
    -------
    tuple of (float, float)
        Real and imaginary part of each pole, as in :class:`FilterBank`.
    """
    return tuple((float(pole), 0.0) for pole in np.exp(-period_s / np.asarray(time_constants_s)))


def read_bank(path: Path) -> FilterBank:
    """Read a bank file.

    Parameters
    ----------
    path : Path
        File that ``calibrator identify --out`` wrote.

    Returns
    -------
    FilterBank
        The bank.

    Raises
    ------
    DriveError
        If it cannot be read or is no filter bank.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=FilterBank)
    except OSError as error:
        raise DriveError(f"{path}: {error.strerror or error}; give a file that 'calibrator identify' wrote") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DriveError(f"{path}: no filter bank ({error}); write it with 'calibrator identify --out'") from None
    except DriveError as error:
        raise DriveError(f"{path}: {error}") from None


def _by_kind(poles: Complex) -> tuple[Array, Complex]:
    """Split poles into the real ones and the complex ones, each of which stands for a pair."""
    return poles.real[poles.imag == 0.0], poles[poles.imag > 0.0]


def _described(pole: complex, period_s: float) -> str:
    radius = abs(pole)
    time_s = f"{-period_s / np.log(radius):.3g} s" if radius > 0.0 else "0 s"
    frequency_hz = np.angle(pole) / (2.0 * np.pi * period_s)
    return time_s if pole.imag == 0.0 else f"{frequency_hz:.3g} Hz ({time_s})"


@compiled
def _filter(
    samples: tuple[Array, Mask], poles: Complex, real: int, limits: NDArray[np.int64], out: tuple[Array, Mask]
) -> None:
    """Run the bank sample by sample; the first `real` poles are real, the others make two columns per input.

    `limits` are the longest hold and the settling, in samples; `out` receives the columns and which samples are used.
    """
    inputs, valid = samples
    columns, used = out
    M, m = inputs.shape[1], len(poles)
    states, held = np.zeros((m, M), np.complex128), np.zeros(M)
    age, unsettled = limits[0] + 1, 0  # samples since the last valid input; samples until the filters have settled
    for t in range(len(inputs)):
        if valid[t]:
            held[:] = inputs[t]
            if age > limits[0]:
                for p in range(m):
                    states[p] = held
                unsettled = limits[1]
            age = 0
        elif age <= limits[0]:
            age += 1
        used[t] = valid[t] and unsettled == 0
        if used[t]:
            columns[t, :M] = held
            for p in range(m):
                columns[t, M * (p + 1) : M * (p + 2)] = states[p].real
                if p >= real:
                    imaginary = M * (p + 1 + m - real)
                    columns[t, imaginary : imaginary + M] = states[p].imag
        if age <= limits[0]:
            unsettled = max(unsettled - 1, 0)
            for p in range(m):
                for i in range(M):
                    states[p, i] = held[i] + poles[p] * (states[p, i] - held[i])
