"""Rules by which the calibrator, and a node on board, sum up drives in blocks; and the file that the node writes.

Branches and inputs are taken at whole multiples of the layout's period since the start of the drive, each interpolated
between its good samples. Of every block of :data:`BLOCK_S` the sums of the products of (inputs, measured currents, 1)
are kept. Spikes are left out; they are looked for in :data:`BATCH_SAMPLES` samples at a time. A block of which less
than :data:`LEAST_SHARE` is valid does not count. :mod:`calibrator.summaries` computes this with arrays, and
:mod:`ecu_node.bus.on_board_summary` in plain Python; a test compares them.
"""

import zlib
from array import array
from collections.abc import Sequence

import msgspec

# ---- what a block is

BLOCK_S = 30.0
"""Length of a block: model errors of different blocks hardly depend on each other. [s]"""
BATCH_SAMPLES = 1500
"""Samples, in whole blocks, that are searched for spikes together: as many as a processor's cache holds. [1]"""
LEAST_SHARE = 0.2
"""A block with a smaller share of valid samples is not used. [1]"""
TIME_RESOLUTION_S = 1e-3
"""Rounding of time stamps in logs; added to limits of time, so that samples exactly one limit apart pass. [s]"""
INSTANT_SLACK = 1e-3
"""An instant within this share of a period or limit from a sample, or from the grid, coincides with it. [1]"""
RANGE_SLACK = 1e-6
"""Tolerance of ranges, so that rounding of decimal scales pushes no value out. [steps of the signal]"""

LEVELS_A = (2, 5, 10, 20, 30, 45, 65, 90, 120, 160, 210, 280, 370, 500, 700, 1000)
"""Positive edges of the levels of a measured current; the negative edges mirror them. [A]"""
DIFFERENCE_GAIN = 20.0
"""Variance of the third difference of white noise of variance 1."""
NORMAL_MEDIAN = 0.6745
"""Median magnitude of a standard normal variable."""
MEDIAN_EXCESS = 3.8
"""The squared median of n third differences of white noise is 1 + this / n times too large (simulated, n = 9 to
300)."""

SPIKE_SDS = 8.0
"""Distance from the running median, in robust standard deviations, from which a sample may be a spike. [1]"""
STEP_OF_SPIKE = 6.0
"""Least change from sample to sample at a spike, in median changes. [1]"""
LEAST_SPIKE_A = 2.5
"""Smaller spikes do no harm, and without noise the steps of a signal must not pass for spikes. [A]"""
OTHERS_MOVE = 0.4
"""Largest change of the other branches around a spike, as a share of it: a current that really flows, or a remaining
delay, shows in two branches. [1]"""
LEAST_EDGE = 0.6
"""Least step up to a spike, and down from it, as a share of it: a true peak of a current has no such steps. [1]"""
SPIKE_WINDOW = 9
"""Number of samples of the running median, which finds spikes of up to four samples. [1]"""
FEWEST_FOR_GAINS = 10
"""Least number of samples per branch from which gains can be estimated. [1]"""
MAD_TO_SD = 1.4826
"""Ratio of the standard deviation of a Gaussian to its median absolute value. [1]"""

ZERO_SETTLING_S = 2.0
"""Time left out after the contactors open and before they close, as capacitors charge and discharge then. [s]"""
FEWEST_ZERO_SAMPLES = 10
"""Least number of samples of a branch in windows with open contactors for its offset reading to count."""
ZERO_RESOLUTION_A = 0.02
"""Least standard deviation of an offset reading: sensors drift by about this much within a window. [A]"""
ZERO_PIECE_S = 5.0
"""Length of the pieces of a window: an offset that wanders within it shows in their medians. [s]"""

# ---- on board

SUFFIX = ".summary"
SCHEMA_VERSION = 2


class SummaryFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Content of a summary file: B batches of K branches and M inputs, p = M + K + 1 columns.

    Numbers in bytes are little-endian float32. Moments of a batch of n samples are kept as mean and covariance, which
    lose nothing in short numbers: the sums of products are n (covariance + mean mean'), that of a column is n mean.
    """

    schema_version: int
    vehicle: str
    layout_sha256: str
    dbc_sha256: str
    branches: list[str]
    inputs: list[str]
    recorded: list[str]
    """Recorded inputs, from which ``inputs`` are computed."""
    period_s: float
    block_s: float
    delay_s: list[float]
    """Delays that were taken out, by branch. [s]"""
    delay_sd_s: list[float | None]
    """Standard deviations of the delays, by branch; null: not known. [s]"""
    zero_offset_a: list[float | None]
    zero_sd_a: list[float | None]
    """Offset of each branch in windows with open contactors, and its standard deviation; null: no reading. [A]"""
    starts: list[bool]
    """Whether a drive starts with each batch."""
    count: list[int]
    """Number of samples of each batch."""
    mean: bytes
    """Means of inputs and currents (B, p - 1)."""
    covariance: bytes
    """Covariances of inputs and currents: lower triangles, row by row (B, (p - 1) p / 2)."""
    noise_a2: bytes
    """Variance of the white noise of each current (B, K). [A^2]"""
    fast_a2: bytes
    """Sums of products of fast changes of each two currents, a fast change being the distance of a sample from the mean
    of its neighbours: lower triangles, row by row (B, K (K + 1) / 2). [A^2]"""
    spikes: bytes
    """Numbers of positive and of negative spikes of each current (B, K, 2)."""
    temperature_c: bytes
    """Mean temperature of the sensors (B,); NaN: not known. [degC]"""
    levels: list[list[int]]
    """Numbers of the levels that each branch's current visited; 0: the most negative one. See :data:`LEVELS_A`."""
    level_sums: bytes
    """For each of these levels p + 1 numbers: sums of (inputs, currents, 1) and of the branch's own current squared."""


def encode_summary(record: SummaryFile) -> bytes:
    """Return the content of a summary file."""
    return zlib.compress(msgspec.msgpack.encode(record), 9)


def decode_summary(content: bytes) -> SummaryFile:
    """Return the record in a summary file; raise ValueError if it is damaged, or of another version."""
    try:
        unpacker = zlib.decompressobj()
        plain = unpacker.decompress(content, 1 << 24)
        if not unpacker.eof:
            raise ValueError("it is cut, or too large")
        record = msgspec.msgpack.decode(plain, type=SummaryFile)
    except (zlib.error, msgspec.DecodeError) as error:
        raise ValueError(str(error)) from None
    if record.schema_version != SCHEMA_VERSION:
        raise ValueError(f"schema version {record.schema_version}, expected {SCHEMA_VERSION}")
    return record


def packed(values: Sequence[float]) -> bytes:
    """Pack numbers as float32."""
    return array("f", values).tobytes()


def unpacked(content: bytes) -> "array[float]":
    """Return the numbers that :func:`packed` has packed; raise ValueError if the length is wrong."""
    return array("f", content)
