"""Samples of a drive through a filter bank, piece by piece; compiled.

The causal rule for invalid samples. An input keeps its last valid value for a limited time. After a longer gap, and at
the start of a drive, the filters start in the steady state of the first valid input, and what they show is not used
until they have settled: until all but a small share of an error in that start is gone. A bank without poles has nothing
to settle: its columns are the plain inputs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled, inlined
from calibrator.drive import Array, Mask

__all__ = ["NEVER", "BankState"]

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
