"""Filter bank: fixed A and B of the state space (2) of [1]_, shared by identical vehicles; each has its own read-out.

The columns of the bank are the inputs u themselves and, per pole p, each input through x(t+1) = p x(t) + (1 - p) u(t):
a low-pass for a real pole, a resonance for a complex one, whose real and imaginary parts are two columns. All columns
depend on inputs alone, so noise of the sensors leaves no bias in a read-out (output error).

The loop over samples is compiled. Its causal rule for invalid samples: an input keeps its last valid value for a
limited time. After a longer gap, and at the start of a drive, the filters start in the steady state of the first valid
input. Their output is not used until they have settled, that is, until all but a small share of an error in that
starting state has decayed. A bank without poles has nothing to settle: its columns are the plain inputs.

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

__all__ = ["FilterBank", "low_passes", "plain_bank", "read_bank"]

LONGEST_HOLD_S = 1.0
"""Time that an input may keep its last valid value: currents of a drive seldom change much within it. [s]"""
UNSETTLED = 0.05
"""Share of an error in the starting state that may remain: it is reached after three time constants of the slowest
pole. [1]"""
LARGEST_RADIUS = 1.0 - 1e-9
"""Largest magnitude of a pole; beyond it the filter never settles. [1]"""

Poles = tuple[tuple[float, float], ...]


class FilterBank(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Poles that all vehicles of a fleet share.

    Attributes
    ----------
    input_names : tuple of str
        Names of the M inputs.
    period_s : float
        Distance of the samples. [s]
    poles : tuple of (float, float)
        Real and imaginary part of each pole in the z-plane, all inside the unit circle; a complex pair is given by its
        pole with positive imaginary part. Empty: the plain inputs.

    Raises
    ------
    DriveError
        If a pole is unstable or not in the upper half plane, the period is not positive, or two inputs share a name.
    """

    input_names: tuple[str, ...]
    period_s: float
    poles: Poles = ()

    def __post_init__(self) -> None:
        """Raise DriveError if the bank cannot be run."""
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
        """Digest of input names, period and poles; only summaries with the same digest may be added up."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]

    @property
    def complex_poles(self) -> Complex:
        """Poles, shape (m,)."""
        return np.array([complex(*pole) for pole in self.poles], np.complex128)

    @property
    def states(self) -> int:
        """Number of states n of all inputs together."""
        return len(self.input_names) * sum(1 if imag == 0.0 else 2 for _, imag in self.poles)

    @property
    def width(self) -> int:
        """Number of columns: inputs and states."""
        return len(self.input_names) + self.states

    @property
    def settling(self) -> int:
        """Samples after a start that are not used."""
        slowest = max((float(np.hypot(*pole)) for pole in self.poles), default=0.0)
        return int(np.ceil(np.log(UNSETTLED) / np.log(slowest))) if slowest > 0.0 else 0

    def system(self) -> tuple[Array, Array]:
        """Return A (n, n) and B (n, M); the states are in the order of the columns that follow the inputs."""
        M = len(self.input_names)
        real, pairs = _by_kind(self.complex_poles)
        own = np.concatenate([real, pairs.real, pairs.real])
        A = np.diag(np.repeat(own, M))
        first, second = len(real) * M, (len(real) + len(pairs)) * M
        swing = np.diag(np.repeat(pairs.imag, M))
        A[first:second, second:], A[second:, first:second] = -swing, swing
        gains = np.concatenate([1.0 - real, 1.0 - pairs.real, -pairs.imag])
        return A, np.kron(gains[:, None], np.eye(M))

    def run(self, inputs: Array, valid: Mask, *, settling: int = 0) -> tuple[Array, Mask]:
        """Filter a drive.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs; finite where valid.
        valid : ndarray of bool of shape (T,)
            Samples that may be used.
        settling : int
            Samples to leave out after a start, if more than :attr:`settling`, so that this bank uses the same samples
            as a slower one with which it is compared.

        Returns
        -------
        columns : ndarray of shape (T, W)
            Inputs and states; zero where not used.
        used : ndarray of bool of shape (T,)
            Which samples are valid and come from settled filters.
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
        """Describe the poles: the time constant of each low-pass, frequency and time constant of each resonance."""
        words = [_described(pole, self.period_s) for pole in self.complex_poles]
        return ", ".join(words) or "the plain inputs"


def plain_bank(input_names: tuple[str, ...], *, period_s: float) -> FilterBank:
    """Return a bank without poles, whose columns are the inputs as they are."""
    return FilterBank(input_names=input_names, period_s=period_s)


def low_passes(time_constants_s: Array, *, period_s: float) -> Poles:
    """Return the poles of first-order low-passes.

    Parameters
    ----------
    time_constants_s : ndarray of shape (m,)
        Time constants. [s]
    period_s : float
        Distance of the samples. [s]

    Returns
    -------
    tuple of (float, float)
        Real and imaginary part (0) of each pole, as in :class:`FilterBank`.
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
    """Split poles into the real ones, and one of each complex pair."""
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
    """Run the bank, sample by sample; the first `real` poles are real, the others are complex and have two columns."""
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
