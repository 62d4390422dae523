"""Parameter file: the result of the calibrator for one vehicle, and its contract with the node.

JSON, UTF-8, one file per vehicle. The structures below are the schema: ``ecu-node schema`` prints the JSON Schema
made from them, which is also in ``ecu_node/parameters.schema.json``. Currents are positive into the junction.
:func:`check_fit` says whether parameters may be applied here.
"""

import codecs
import json
import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from ecu_node.core.correction import NO_FAULT, SensorFault
from ecu_node.core.status import Reason, UnfitError
from ecu_node.documents import UnsuitableFileError, field_error, read_user_file, write_atomically
from ecu_node.errors import ParameterError, printable, shown_name

if TYPE_CHECKING:
    from ecu_node.database import VehicleDatabase

__all__ = [
    "NOTHING_EXPECTED",
    "BranchParameters",
    "Explanation",
    "FileReference",
    "HardwareFault",
    "HeldBack",
    "JunctionResidual",
    "Provenance",
    "SensorFinding",
    "VehicleParameters",
    "Verdict",
    "check_fit",
    "decode_parameters",
    "encode_parameters",
    "parameter_bytes",
    "parameter_schema",
    "read_parameters",
    "write_parameters",
]

MAX_FILE_BYTES = 1_000_000
"""A parameter file has some kilobytes; a larger file cannot be one."""

Verdict = Literal["no sensor fault", "corrected", "cannot tell", "not enough data"]
"""What the calibration concluded about the sensors of one vehicle."""

HeldBack = Literal["beyond the limits", "does not fit", "reference in doubt", "moved too little", "harm limit"]
"""Why a branch with a fault is passed through; "does not fit": no gain error and offset explain its recordings."""

_Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", description="SHA-256: 64 digits 0-9 and a-f")]
_Text64 = Annotated[str, Meta(min_length=1, max_length=64)]
_Share = Annotated[float, Meta(ge=0.0, le=1.0)]
_NotNegative = Annotated[float, Meta(ge=0.0)]
_MeanSum = Annotated[float, Meta(ge=-1e6, le=1e6)]  # beyond any vehicle's currents, yet its square is finite
_RmsSum = Annotated[float, Meta(ge=0.0, le=1e6)]
_Number = Annotated[int, Meta(ge=1, le=(1 << 53) - 1)]  # beyond it readers of JSON disagree


class BranchParameters(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sensor fault of one branch: measured = (1 + drift) * true + offset, (13) of the paper."""

    drift: Annotated[float, Meta(gt=-1.0, lt=1.0, description="relative gain error of the sensor [1]")]
    offset_a: Annotated[float, Meta(description="offset of the sensor, positive into the junction [A]")]
    drift_sd: Annotated[_NotNegative | None, Meta(description="standard deviation of the drift [1]")] = None
    offset_sd_a: Annotated[_NotNegative | None, Meta(description="standard deviation of the offset [A]")] = None
    apply: Annotated[bool, Meta(description="false: the node passes this branch through")]
    held_back: Annotated[HeldBack | None, Meta(description="why a fault that was found is not applied")] = None
    sensor_model: Annotated[msgspec.UnsetType | None, Meta(description="always null; of version 1.0")] = msgspec.UNSET
    delay_s: Annotated[float | None, Meta(description="how much later than the largest branch it is seen [s]")] = None
    delay_sd_s: Annotated[_NotNegative | None, Meta(description="standard deviation of the delay [s]")] = None
    fault_probability: Annotated[_Share | None, Meta(description="probability that this sensor is faulty")] = None
    harm_probability: Annotated[_Share | None, Meta(description="probability that these values make it worse")] = None
    identifiable: Annotated[bool, Meta(description="false: the branch moved too little for its gain to be told")] = True


class HardwareFault(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whether and by how much the vehicle itself differs from its fleet, (11) of the paper. It is never corrected."""

    suspected: bool
    drift: Annotated[float, Meta(description="common relative change of all currents [1]")] = 0.0
    offset_a: Annotated[dict[str, float], Meta(description="change of each branch current; the sum is 0 [A]")] = {}
    probability: Annotated[_Share | None, Meta(description="null if the method gives none")] = None


class Explanation(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way to explain a vehicle's recordings; several are given where the calibrator cannot tell."""

    probability: _Share
    drift: Annotated[dict[str, float], Meta(description="of the sensors that it holds for faulty [1]")] = {}
    offset_a: Annotated[dict[str, float], Meta(description="of the same [A]")] = {}
    hardware_drift: Annotated[float, Meta(description="[1]")] = 0.0
    hardware_offset_a: Annotated[dict[str, float], Meta(description="[A]")] = {}


class SensorFinding(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a check found in the recordings that no gain error and offset explain; the node ignores it."""

    branch: Annotated[_Text64 | None, Meta(description="whose sensor it is about; null: the vehicle as a whole")] = None
    cause: Annotated[_Text64, Meta(description="what it looks like, such as 'inverted' or 'clipped'")]
    probability: Annotated[_Share, Meta(description="probability of this cause")]
    text: Annotated[str, Meta(min_length=1, max_length=500, description="the same in a sentence")]


class JunctionResidual(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Kirchhoff sum on the drives that were used for the calibration.

    A single corrected sum, as the node takes it, scatters around expected_a with the variance corrected_sd_a^2 +
    (corrected_sd_per_a * throughput)^2, where throughput is half the sum of the magnitudes of all currents.
    """

    measured_a: Annotated[_RmsSum, Meta(description="root mean square, from measured currents [A]")]
    corrected_a: Annotated[_RmsSum, Meta(description="the same from corrected currents [A]")]
    correction_a: Annotated[_RmsSum | None, Meta(description="the same of the difference of the two [A]")] = None
    measured_mean_a: Annotated[_MeanSum | None, Meta(description="mean, from measured currents [A]")] = None
    corrected_mean_a: Annotated[_MeanSum | None, Meta(description="the same from corrected currents [A]")] = None
    expected_a: Annotated[_MeanSum, Meta(description="mean that right sensors show: a load that none sees [A]")] = 0.0
    corrected_sd_a: Annotated[_RmsSum | None, Meta(description="standard deviation without current [A]")] = None
    corrected_sd_per_a: Annotated[_Share | None, Meta(description="how much of it grows with the current [1]")] = None

    def about_expected(self) -> tuple[float, float]:
        """Return the RMS of measured and corrected sum about expected_a; about 0 if a mean is not known. [A]"""
        if self.measured_mean_a is None or self.corrected_mean_a is None:
            return self.measured_a, self.corrected_a

        def about(rms_a: float, mean_a: float) -> float:
            return math.sqrt(max(rms_a**2 - 2.0 * self.expected_a * mean_a + self.expected_a**2, 0.0))

        return about(self.measured_a, self.measured_mean_a), about(self.corrected_a, self.corrected_mean_a)


NOTHING_EXPECTED = JunctionResidual(measured_a=0.0, corrected_a=0.0)
"""Expected sums where no parameters are in force."""


class FileReference(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file that the parameters belong to."""

    name: str
    sha256: _Digest


class Provenance(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the parameters come from."""

    tool: str
    method: str
    created: Annotated[str, Meta(description="ISO 8601, UTC")]
    fleet: str
    fleet_size: Annotated[int, Meta(ge=1)]
    drives: list[str]
    duration_s: Annotated[_NotNegative, Meta(description="length of the drives used [s]")]


class VehicleParameters(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One parameter file. Where a key may be null, that means not known, as if it were left out."""

    schema_version: Literal[1] = 1
    vehicle: Annotated[str, Meta(min_length=1, max_length=64)]
    number: Annotated[_Number, Meta(description="number of the parameter set, published modulo 256")] = 1
    layout: FileReference
    dbc: FileReference
    verdict: Verdict
    confidence: Annotated[_Share | None, Meta(description="probability that the verdict holds")] = None
    branches: Annotated[dict[str, BranchParameters], Meta(min_length=1, max_length=16)]
    hardware_fault: HardwareFault
    explanations: Annotated[list[Explanation], Meta(description="the likeliest, where the calibrator cannot tell")] = []
    deciding_evidence: Annotated[str, Meta(description="what would tell the explanations apart")] = ""
    findings: Annotated[list[SensorFinding], Meta(max_length=64, description="what a workshop should look at")] = []
    junction_residual: JunctionResidual
    provenance: Provenance

    def fault(self, branch: str) -> SensorFault:
        """Return the fault that is corrected on one branch; NO_FAULT if nothing is applied."""
        found = self.branches.get(branch)
        return (
            SensorFault(drift=found.drift, offset_a=found.offset_a) if found is not None and found.apply else NO_FAULT
        )


def read_parameters(path: Path) -> VehicleParameters:
    """Read a parameter file and check it against the schema.

    Parameters
    ----------
    path : Path
        The JSON file.

    Returns
    -------
    VehicleParameters
        The parameters; nothing is applied yet, see :func:`~ecu_node.parameters.check_fit`.

    Raises
    ------
    UnfitError
        With reason NO_PARAMETERS if there is no such file or it may not be read, else MALFORMED_PARAMETERS.
    """
    return decode_parameters(parameter_bytes(path), str(path))


def parameter_bytes(path: Path) -> bytes:
    """Read the bytes of a parameter file for :func:`decode_parameters`; errors are those of :func:`read_parameters`."""
    try:
        return read_user_file(path, largest_bytes=MAX_FILE_BYTES)
    except FileNotFoundError:
        raise UnfitError(Reason.NO_PARAMETERS, f"{path}: no such parameter file; name one that is there") from None
    except UnsuitableFileError as error:
        raise UnfitError(Reason.MALFORMED_PARAMETERS, f"{path}: not a parameter file: {error}") from None
    except OSError as error:
        why = f"{path}: cannot read the parameter file: {error.strerror}; name one that may be read"
        raise UnfitError(Reason.NO_PARAMETERS, why) from None


def decode_parameters(content: bytes, where: str) -> VehicleParameters:
    """Read parameters from the bytes of a parameter file; `where` names its origin in messages.

    Raises
    ------
    UnfitError
        With reason MALFORMED_PARAMETERS if it is no JSON, outside the schema, or has a key twice in one table.
    """
    if not content.strip():
        raise _malformed(where, "it is empty")
    if content.startswith(codecs.BOM_UTF8):
        raise _malformed(where, "it begins with a byte order mark (BOM); save it as UTF-8 without one")
    try:
        document = msgspec.json.decode(content)
    except RecursionError:
        raise _malformed(where, "it is nested too deeply") from None
    except UnicodeDecodeError:
        raise _malformed(where, "it is no text in UTF-8") from None
    except msgspec.DecodeError as error:
        raise _malformed(where, str(error).partition(" - at `")[0]) from None  # the rest names no key
    try:
        parameters = msgspec.json.decode(content, type=VehicleParameters)
    except msgspec.ValidationError as error:
        steps, what = field_error(error, document, VehicleParameters)
        raise _malformed(where, f"{', '.join(steps)}: {what}" if steps else what) from None

    def require_once(pairs: list[tuple[str, Any]]) -> None:
        """Refuse a table in which a key stands twice: msgspec takes the last one silently."""
        if twice := [key for key, count in Counter(key for key, _ in pairs).items() if count > 1]:
            raise _malformed(where, f"key {shown_name(twice[0])!r} stands twice in one table; leave one of them")

    json.loads(content, object_pairs_hook=require_once)
    return parameters


def _malformed(where: str, why: str) -> UnfitError:
    advice = "correct it, or write it anew with 'calibrator calibrate'"
    return UnfitError(Reason.MALFORMED_PARAMETERS, f"{where}: not a parameter file: {printable(why)}; {advice}")


def encode_parameters(parameters: VehicleParameters, where: str) -> bytes:
    """Encode parameters as the content of a parameter file.

    Parameters
    ----------
    parameters : VehicleParameters
        Parameters to encode.
    where : str
        Name of the file, for messages.

    Returns
    -------
    bytes
        JSON, indented.

    Raises
    ------
    ParameterError
        If it could not be read back: a number is not finite, which JSON cannot hold, or a field is outside the schema.
    """
    content = msgspec.json.encode(parameters)
    try:
        read_back = msgspec.json.decode(content, type=VehicleParameters)
    except msgspec.DecodeError as error:
        raise ParameterError(
            f"{where}: {error}; numbers that are not finite count as null; nothing was written"
        ) from None
    if read_back != parameters:
        raise ParameterError(
            f"{where}: a standard deviation or the confidence is not finite; leave it out where it is not known; "
            f"nothing was written"
        )
    return msgspec.json.format(content) + b"\n"


def write_parameters(parameters: VehicleParameters, path: Path) -> None:
    """Write a parameter file, whole or not at all.

    Parameters
    ----------
    parameters : VehicleParameters
        Parameters to write.
    path : Path
        File to write; its folder must exist.

    Raises
    ------
    ParameterError
        If the parameters cannot be read back, see :func:`encode_parameters`; nothing is written.
    """
    write_atomically(path, encode_parameters(parameters, str(path)))


def parameter_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of the parameter file, made from the structures of this module."""
    schema = msgspec.json.schema(VehicleParameters)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Vehicle parameter file", **schema}


_LARGEST_DELAY_S = 5.0
"""Largest delay that is plausible between branches of one vehicle. [s]"""


def check_fit(parameters: VehicleParameters, database: "VehicleDatabase", vehicle: str | None) -> None:
    """Check that parameters are for this vehicle, layout and DBC, fit their verdict, and are within limits.

    A file whose verdict is another than "corrected" fits only if it corrects no branch. Drift and offset of
    applied branches keep to the layout's limits, the expected sum always to its limit of offsets, and the delay of
    every branch to 5 s. A branch that the layout lacks does not fit.

    Parameters
    ----------
    parameters : VehicleParameters
        From :func:`~ecu_node.parameters.read_parameters`.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle that the node runs on; None: not checked.

    Raises
    ------
    UnfitError
        With the reason that the node then publishes; the message gives the value found and the one expected.
    """
    layout, verdict = database.layout, parameters.verdict
    if vehicle is not None and parameters.vehicle != vehicle:
        text = f"parameters are for vehicle {parameters.vehicle!r}, this is {vehicle!r}"
        raise UnfitError(Reason.WRONG_VEHICLE, text)
    for reason, what, made_with, path, digest in (
        (Reason.WRONG_LAYOUT, "layout", parameters.layout, layout.path, layout.digest),
        (Reason.WRONG_DBC, "DBC", parameters.dbc, layout.dbc_path, database.digest),
    ):
        if made_with.sha256 != digest:
            raise UnfitError(
                reason,
                f"parameters were made with {what} {shown_name(made_with.name)} ({made_with.sha256[:12]}), this is "
                f"{path} ({digest[:12]}); calibrate with this {what}; for a file made by hand print a new "
                f"'ecu-node template'",
            )
    for name in parameters.branches.keys() - set(layout.branch_names):
        text = f"parameters for branch {shown_name(name)!r}, which {layout.path} does not have"
        raise UnfitError(Reason.WRONG_LAYOUT, text)
    drift, offset_a, expected_a = layout.limits.drift, layout.offset_limit_a, parameters.junction_residual.expected_a
    applied = [name for name in parameters.branches if parameters.fault(name).applied]
    texts = []
    if verdict != "corrected" and applied:
        texts.append(
            f"verdict {verdict!r}, yet 'apply' is true for {', '.join(map(shown_name, applied))}; only 'corrected' "
            f"goes with that, calibrate anew"
        )
    if not abs(expected_a) <= offset_a:
        beyond = f"beyond the layout's limit of offsets, {offset_a:g} A"
        texts.append(f"an expected Kirchhoff sum of {expected_a:+.4g} A is {beyond}")
    for name, branch in parameters.branches.items():
        for what, value, limit, unit, is_applied in (
            ("delay", branch.delay_s or 0.0, _LARGEST_DELAY_S, " s", True),
            ("drift", branch.drift, drift, "", branch.apply),
            ("offset", branch.offset_a, offset_a, " A", branch.apply),
        ):
            if is_applied and not abs(value) <= limit:
                of = "" if what == "delay" else "the layout's limit of "
                texts.append(f"branch {name}: {what} {value:+.4g}{unit} is beyond {of}{limit:g}{unit}")
    if texts:
        raise UnfitError(Reason.IMPLAUSIBLE_PARAMETERS, texts[0])
