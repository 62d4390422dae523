"""Filter bank: fixed A and B of the state space (2) of [1]_, shared by identical vehicles; each has its own read-out.

Columns of the bank are the inputs u themselves and, per pole p, each input through x(t+1) = p x(t) + (1 - p) u(t): a
low-pass for a real pole, a resonance for a complex one, of which real and imaginary part are two columns. All of them
depend on inputs alone, so noise of the sensors leaves no bias in a read-out (output error).

How samples run through it is compiled. The causal rule for invalid samples: an input keeps its last valid value for a
limited time. After a longer gap, and at the start of a drive, the filters start in the steady state of the first valid
input, and what they show is not used until they have settled: until all but a small share of an error in that start is
gone. A bank without poles has nothing to settle: its columns are the plain inputs.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled, inlined
from calibrator.drive import Array, Complex, Mask
from calibrator.errors import DriveError

__all__ = ["BankState", "FilterBank", "low_pass_bank", "low_passes", "plain_bank", "read_bank"]

LONGEST_HOLD_S = 1.0
"""Time that an input may keep its last valid value: currents of a drive seldom change more within. [s]"""
UNSETTLED = 0.05
"""Share of the error of a start that may remain: after three time constants of the slowest pole. [1]"""
LARGEST_RADIUS = 1.0 - 1e-9
"""Of a pole that settles at all. [1]"""

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
        Real and imaginary part of each pole of the z-plane, all inside the unit circle; of a complex pair the one with
        positive imaginary part. Empty: the plain inputs.

    Raises
    ------
    DriveError
        If a pole is not stable or not of the upper half plane, the period not positive, or two inputs have one name.
    """

    input_names: tuple[str, ...]
    period_s: float
    poles: Poles = ()

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
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
        """Digest of input names, period and poles: summaries of different banks do not belong together."""
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

    @property
    def holding(self) -> int:
        """Samples that an input may keep its last valid value."""
        return round(LONGEST_HOLD_S / self.period_s)

    def system(self) -> tuple[Array, Array]:
        """Return A (n, n) and B (n, M); the states in the order of the columns that follow the inputs."""
        M = len(self.input_names)
        real, pairs = _by_kind(self.complex_poles)
        own = np.concatenate([real, pairs.real, pairs.real])
        A = np.diag(np.repeat(own, M))
        first, second = len(real) * M, (len(real) + len(pairs)) * M
        swing = np.diag(np.repeat(pairs.imag, M))
        A[first:second, second:], A[second:, first:second] = -swing, swing
        gains = np.concatenate([1.0 - real, 1.0 - pairs.real, -pairs.imag])
        return A, np.kron(gains[:, None], np.eye(M))

    def start(self, *, settling: int = 0) -> "BankState":
        """State before the first sample of a drive.

        Parameters
        ----------
        settling : int
            Samples after a start that are not used, if they are more than :attr:`settling`: that of another bank, to be
            compared with.

        Returns
        -------
        BankState
            To run the bank from.
        """
        (real, pairs), M = _by_kind(self.complex_poles), len(self.input_names)
        return BankState(
            states=np.zeros(self.states),
            held=np.zeros(M),
            counters=np.array([NEVER, 0]),
            limits=np.array([self.holding, max(settling, self.settling)]),
            poles=(np.repeat(real, M), np.repeat(pairs.real, M), np.repeat(pairs.imag, M)),
        )

    def run(self, inputs: Array, valid: Mask, state: "BankState") -> tuple[Array, Mask]:
        """Filter the next samples of a drive, however many.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs; finite where valid.
        valid : ndarray of bool of shape (T,)
            Samples that may be used.
        state : BankState
            Where the last piece of the drive ended; it is carried on in place.

        Returns
        -------
        columns : ndarray of shape (T, W)
            Inputs and states; zero where not used.
        used : ndarray of bool of shape (T,)
            Valid samples of settled filters.
        """
        columns, used = np.zeros((len(inputs), self.width)), np.zeros(len(inputs), np.bool_)
        state.run_into(columns, used, inputs, valid)
        return columns, used

    def to_json(self) -> bytes:
        """Text of a bank file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"

    def described(self) -> str:
        """Poles in words: time constants of low-passes, and frequencies of resonances with theirs."""
        words = [_described(pole, self.period_s) for pole in self.complex_poles]
        return ", ".join(words) or "the plain inputs"


def plain_bank(input_names: tuple[str, ...], *, period_s: float) -> FilterBank:
    """Bank of the inputs as they are."""
    return FilterBank(input_names=input_names, period_s=period_s)


def low_passes(time_constants_s: Array, *, period_s: float) -> Poles:
    """Poles of first-order low-passes.

    Parameters
    ----------
    time_constants_s : ndarray of shape (m,)
        Time constants. [s]
    period_s : float
        Distance of the samples. [s]

    Returns
    -------
    tuple of (float, float)
        As :class:`FilterBank` has them.
    """
    return tuple((float(pole), 0.0) for pole in np.exp(-period_s / np.asarray(time_constants_s)))


def low_pass_bank(input_names: tuple[str, ...], time_constants_s: Sequence[float], *, period_s: float) -> FilterBank:
    """Bank of the inputs and of first-order low-passes of each, by their time constants. [s]"""
    poles = low_passes(np.array(time_constants_s), period_s=period_s)
    return FilterBank(input_names=input_names, period_s=period_s, poles=poles)


def read_bank(path: Path) -> FilterBank:
    """Read a bank file.

    Parameters
    ----------
    path : Path
        What ``calibrator identify --out`` wrote.

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
    """Real poles, and one of each complex pair."""
    return poles.real[poles.imag == 0.0], poles[poles.imag > 0.0]


def _described(pole: complex, period_s: float) -> str:
    radius = abs(pole)
    time_s = f"{-period_s / np.log(radius):.3g} s" if radius > 0.0 else "0 s"
    frequency_hz = np.angle(pole) / (2.0 * np.pi * period_s)
    return time_s if pole.imag == 0.0 else f"{frequency_hz:.3g} Hz ({time_s})"


# ---- samples through the bank

NEVER = np.iinfo(np.int64).max
"""Samples since the last valid input, where there was none."""


@dataclass(frozen=True, kw_only=True)
class BankState:
    """What a bank remembers between two pieces of a drive: running it changes the first three arrays.

    Attributes
    ----------
    states : ndarray of shape (n,)
        Real poles first, then the real and the imaginary parts of the others; per pole all inputs.
    held : ndarray of shape (M,)
        Last valid input.
    counters : ndarray of int of shape (2,)
        Samples since the last valid input, and samples until the filters have settled.
    limits : ndarray of int of shape (2,)
        Samples that an input may keep its value, and samples after a start that are not used.
    poles : tuple of ndarray
        One per state: real poles, real parts of the others, their imaginary parts.
    """

    states: Array
    held: Array
    counters: NDArray[np.int64]
    limits: NDArray[np.int64]
    poles: tuple[Array, Array, Array]

    @property
    def settling(self) -> int:
        """Samples after a start that are not used."""
        return int(self.limits[1])

    def run_into(self, columns: Array, used: Mask, inputs: Array, valid: Mask) -> None:
        """Filter as :meth:`.FilterBank.run`, into the first W columns of rows at hand; those not used become zero."""
        samples = (np.ascontiguousarray(inputs, np.float64), np.ascontiguousarray(valid))
        memory = (self.states, self.held, self.counters)
        _filter(samples, self.poles, self.limits, memory, (columns, used))


@compiled
def _filter(
    samples: tuple[Array, Mask],
    poles: tuple[Array, Array, Array],
    limits: NDArray[np.int64],
    memory: tuple[Array, Array, NDArray[np.int64]],
    out: tuple[Array, Mask],
) -> None:
    """Run the bank, sample by sample; poles (one per state) are real ones, real parts and imaginary parts of pairs."""
    inputs, valid = samples
    columns, used = out
    low, re, im = poles
    states, held, counters = memory
    inputs_of_states = np.empty(len(states))
    _spread(held, inputs_of_states)
    for t in range(len(inputs)):
        if valid[t]:
            held[:] = inputs[t]
            _spread(held, inputs_of_states)
            if counters[0] > limits[0]:
                states[: len(low) + len(re)] = inputs_of_states[: len(low) + len(re)]
                states[len(low) + len(re) :] = 0.0
                counters[1] = limits[1]
            counters[0] = 0
        elif counters[0] <= limits[0]:
            counters[0] += 1
        used[t] = valid[t] and counters[1] == 0
        if used[t]:
            _copy(held, columns[t])
            _copy(states, columns[t, len(held) :])
        else:
            columns[t] = 0.0
        if counters[0] <= limits[0]:
            counters[1] = max(counters[1] - 1, 0)
            _step(states, inputs_of_states, low, re, im)


@inlined
def _spread(held: Array, inputs_of_states: Array) -> None:
    """Give every state its input; per pole there are all of them."""
    for m in range(len(held)):
        for i in range(m, len(inputs_of_states), len(held)):
            inputs_of_states[i] = held[m]


@inlined
def _copy(values: Array, row: Array) -> None:
    for i in range(len(values)):
        row[i] = values[i]


@inlined
def _step(states: Array, u: Array, low: Array, re: Array, im: Array) -> None:
    """Next states; what they differ from the input by turns and shrinks."""
    first, second = len(low), len(low) + len(re)
    for i in range(first):
        states[i] = u[i] + low[i] * (states[i] - u[i])
    for i in range(len(re)):
        x, y = states[first + i] - u[first + i], states[second + i]
        states[first + i] = u[first + i] + re[i] * x - im[i] * y
        states[second + i] = im[i] * x + re[i] * y
