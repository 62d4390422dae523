"""Parameter file: what the calibrator found for one vehicle, and the contract with the node.

JSON, UTF-8, one file per vehicle. The structures below are the schema: ``ecu-node schema`` prints the JSON Schema
made from them, which stands in ``ecu_node/parameters.schema.json``. Currents are positive into the junction.
:func:`check_fit` says whether parameters may be applied here.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase
from ecu_node.errors import ParameterError, UnfitError, printable, shown_name
from ecu_node.fields import field_error, json_error, quoted_place, repeated_key
from ecu_node.layout import Layout
from ecu_node.user_files import UnsuitableFileError, read_user_file, write_atomically

__all__ = [
    "BranchParameters",
    "Explanation",
    "FileReference",
    "Finding",
    "HardwareFault",
    "HeldBack",
    "JunctionResidual",
    "Provenance",
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
"""A parameter file has some kilobytes; a larger one is not one."""

_LARGEST_NUMBER = (1 << 53) - 1
"""Beyond it readers of JSON differ."""
_SIGNED = "this file is signed"
_SIGNED_ADVICE = "use 'ecu-node activate' and --state, or name the file that was signed"

Verdict = Literal["no sensor fault", "corrected", "cannot tell", "not enough data"]
"""What was found of the sensors of one vehicle."""

_NO_MODELS = "sensors that are not linear are not corrected any more"

HeldBack = Literal["beyond the limits", "does not fit", "reference in doubt", "moved too little", "harm limit"]
"""Why a branch in which a fault was found is passed through; "does not fit": no gain error and offset explain it."""

_Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$", description="SHA-256, line ends counted as LF")]
_Text64 = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
_NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
_MeanSum = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]  # no vehicle has such currents, and squares are still finite
_RmsSum = Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]


class BranchParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sensor fault of one branch: measured = (1 + drift) * true + offset, (13) of the paper."""

    drift: Annotated[float, msgspec.Meta(gt=-1.0, lt=1.0, description="relative gain error of the sensor [1]")]
    offset_a: Annotated[float, msgspec.Meta(description="offset of the sensor, positive into the junction [A]")]
    drift_sd: Annotated[_NotNegative | None, msgspec.Meta(description="standard deviation of the drift [1]")] = None
    offset_sd_a: Annotated[_NotNegative | None, msgspec.Meta(description="standard deviation of the offset [A]")] = None
    apply: Annotated[bool, msgspec.Meta(description="false: the node passes this branch through")]
    held_back: Annotated[
        HeldBack | None, msgspec.Meta(description="why a fault that was found is not applied; null: none, or it is")
    ] = None
    sensor_model: Annotated[
        msgspec.UnsetType | None,
        msgspec.Meta(description="always null; only files of version 1.0 have it"),
    ] = msgspec.UNSET
    delay_s: Annotated[
        float | None, msgspec.Meta(description="how much later than the largest branch it is seen [s]; null: unknown")
    ] = None
    delay_sd_s: Annotated[_NotNegative | None, msgspec.Meta(description="standard deviation of the delay [s]")] = None
    fault_probability: Annotated[
        _Share | None, msgspec.Meta(description="probability that this sensor is faulty; null if the method gives none")
    ] = None
    harm_probability: Annotated[
        _Share | None, msgspec.Meta(description="probability that correcting with these values makes it worse")
    ] = None
    identifiable: Annotated[
        bool, msgspec.Meta(description="false: the branch moved too little for its gain to be told")
    ] = True


class HardwareFault(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whether the vehicle itself differs from its fleet, (11) of the paper. Never corrected, only reported."""

    suspected: bool
    drift: Annotated[float, msgspec.Meta(description="common relative change of all currents [1]")] = 0.0
    offset_a: Annotated[
        dict[str, float], msgspec.Meta(description="change of each branch current; the sum is 0 [A]")
    ] = {}
    probability: Annotated[_Share | None, msgspec.Meta(description="null if the method gives none")] = None


class Explanation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way to explain a vehicle's recordings; several are given where the calibrator cannot tell."""

    probability: _Share
    drift: Annotated[dict[str, float], msgspec.Meta(description="of the sensors that it holds for faulty [1]")] = {}
    offset_a: Annotated[dict[str, float], msgspec.Meta(description="of the same [A]")] = {}
    hardware_drift: Annotated[float, msgspec.Meta(description="[1]")] = 0.0
    hardware_offset_a: Annotated[dict[str, float], msgspec.Meta(description="[A]")] = {}


class Finding(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a check found in the recordings that no gain error and offset explain; the node ignores it."""

    branch: Annotated[
        _Text64 | None, msgspec.Meta(description="whose sensor it is about; null: the vehicle as a whole")
    ] = None
    cause: Annotated[_Text64, msgspec.Meta(description="what it looks like, such as 'inverted' or 'clipped'")]
    probability: Annotated[_Share, msgspec.Meta(description="probability of this cause")]
    text: Annotated[str, msgspec.Meta(min_length=1, max_length=500, description="the same in a sentence")]


class JunctionResidual(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Kirchhoff sum on the drives used."""

    measured_a: Annotated[_RmsSum, msgspec.Meta(description="root mean square, from measured currents [A]")]
    corrected_a: Annotated[_RmsSum, msgspec.Meta(description="the same from corrected currents [A]")]
    correction_a: Annotated[
        _RmsSum | None, msgspec.Meta(description="the same of the difference of the two; null: not known [A]")
    ] = None
    measured_mean_a: Annotated[
        _MeanSum | None, msgspec.Meta(description="mean, from measured currents; null: not known [A]")
    ] = None
    corrected_mean_a: Annotated[
        _MeanSum | None, msgspec.Meta(description="the same from corrected currents; null: not known [A]")
    ] = None
    expected_a: Annotated[
        _MeanSum, msgspec.Meta(description="mean sum that right sensors show: a load that none of them sees [A]")
    ] = 0.0
    corrected_sd_a: Annotated[
        _RmsSum | None,
        msgspec.Meta(
            description="standard deviation about expected_a of single corrected sums, as the node takes them, while "
            "no current flows; null: not known [A]"
        ),
    ] = None
    corrected_sd_per_a: Annotated[
        _Share | None,
        msgspec.Meta(
            description="how much of it grows with the throughput, half the sum of the magnitudes of all currents: "
            "sd^2 = corrected_sd_a^2 + (corrected_sd_per_a * throughput)^2; null: not known [1]"
        ),
    ] = None

    def about_expected(self) -> tuple[float, float]:
        """Root mean squares of measured and corrected sum less what is expected; as they are if no means are known."""
        if self.measured_mean_a is None or self.corrected_mean_a is None:
            return self.measured_a, self.corrected_a
        sums = ((self.measured_a, self.measured_mean_a), (self.corrected_a, self.corrected_mean_a))
        measured_a, corrected_a = (
            math.sqrt(max(rms_a**2 - 2.0 * self.expected_a * mean_a + self.expected_a**2, 0.0))
            for rms_a, mean_a in sums
        )
        return measured_a, corrected_a


class FileReference(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file that the parameters belong to."""

    name: str
    sha256: _Digest


class Provenance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the parameters come from."""

    tool: str
    method: str
    created: Annotated[str, msgspec.Meta(description="ISO 8601, UTC")]
    fleet: str
    fleet_size: Annotated[int, msgspec.Meta(ge=1)]
    drives: list[str]
    duration_s: Annotated[_NotNegative, msgspec.Meta(description="length of the drives used [s]")]


class VehicleParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One parameter file."""

    schema_version: Literal[1] = 1
    vehicle: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    number: Annotated[
        int, msgspec.Meta(ge=1, le=_LARGEST_NUMBER, description="number of the parameter set, published modulo 256")
    ] = 1
    layout: FileReference
    dbc: FileReference
    verdict: Verdict
    confidence: Annotated[
        _Share | None, msgspec.Meta(description="probability that the verdict holds; null if the method gives none")
    ] = None
    branches: Annotated[dict[str, BranchParameters], msgspec.Meta(min_length=1, max_length=16)]
    hardware_fault: HardwareFault
    explanations: Annotated[
        list[Explanation], msgspec.Meta(description="the most probable ones, where the calibrator cannot tell")
    ] = []
    deciding_evidence: Annotated[
        str, msgspec.Meta(description="what would tell the explanations apart; empty if nothing has to")
    ] = ""
    findings: Annotated[
        list[Finding], msgspec.Meta(max_length=64, description="what a workshop should look at; no correction mends it")
    ] = []
    junction_residual: JunctionResidual
    provenance: Provenance


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
    """Text of a parameter file, for :func:`decode_parameters`; raises as :func:`read_parameters`."""
    try:
        return read_user_file(path, largest_bytes=MAX_FILE_BYTES)
    except FileNotFoundError:
        raise UnfitError(Reason.NO_PARAMETERS, f"{path}: no such parameter file; name one that is there") from None
    except OSError as error:
        why = f"{path}: cannot read the parameter file: {error.strerror}; name one that may be read"
        raise UnfitError(Reason.NO_PARAMETERS, why) from None
    except UnsuitableFileError as error:
        raise UnfitError(Reason.MALFORMED_PARAMETERS, f"{path}: not a parameter file: {error}") from None


def decode_parameters(content: bytes, where: str) -> VehicleParameters:
    """Read the text of a parameter file; `where` it is from, for messages.

    Raises
    ------
    UnfitError
        With reason MALFORMED_PARAMETERS if it is no JSON, outside the schema, signed, or has a key twice.
    """
    try:
        found = msgspec.json.decode(content, type=VehicleParameters)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _malformed(where, _why_not(error, content)) from None
    if (twice := repeated_key(content)) is not None:
        raise _malformed(where, _stands_twice(twice))
    return found


def _stands_twice(key: str) -> str:
    return f"'{shown_name(key)}' stands there twice in one place"


def _malformed(where: str, why: str) -> UnfitError:
    advice = _SIGNED_ADVICE if why == _SIGNED else "correct it, or write it anew with 'calibrator calibrate'"
    return UnfitError(Reason.MALFORMED_PARAMETERS, f"{where}: not a parameter file: {printable(why)}; {advice}")


def _why_not(error: Exception, content: bytes) -> str:
    if not isinstance(error, msgspec.ValidationError):
        return json_error(error, content)
    try:
        document, twice = msgspec.json.decode(content), repeated_key(content)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as first:
        return json_error(first, content)
    if twice is not None:  # the document keeps the last of the two, and the error may be about the first
        return _stands_twice(twice)
    if isinstance(document, dict) and {"payload", "payloadType", "signatures"} <= document.keys():
        return _SIGNED
    why = field_error(error, document, VehicleParameters, quoted_place)
    return f"{why}: {_NO_MODELS}" if "'sensor_model': null is expected" in why else why


def encode_parameters(parameters: VehicleParameters, where: str) -> bytes:
    """Text of a parameter file.

    Parameters
    ----------
    parameters : VehicleParameters
        What it says.
    where : str
        Where it is to stand, for messages.

    Returns
    -------
    bytes
        JSON.

    Raises
    ------
    ParameterError
        If it could not be read back: a number is not finite, which JSON cannot say, or a field is outside the schema.
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
    return msgspec.json.format(content, indent=2) + b"\n"


def write_parameters(parameters: VehicleParameters, path: Path) -> None:
    """Write a parameter file, whole or not at all.

    Parameters
    ----------
    parameters : VehicleParameters
        What to write.
    path : Path
        Where; the folder must exist.

    Raises
    ------
    ParameterError
        As :func:`encode_parameters`; nothing is written.
    """
    write_atomically(path, encode_parameters(parameters, str(path)))


def parameter_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of the parameter file, made from the structures of this module."""
    schema = msgspec.json.schema(VehicleParameters)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Vehicle parameter file", **schema}


_LARGEST_DELAY_S = 5.0
"""Branches of one vehicle do not lag each other by more. [s]"""
_UNDECIDED: tuple[Verdict, ...] = ("cannot tell", "not enough data")
"""Verdicts with which nothing was found that could be applied."""


def check_fit(parameters: VehicleParameters, database: VehicleDatabase, vehicle: str | None) -> None:
    """Check that parameters were made for this vehicle, layout and DBC, decided on, and within the layout's limits.

    A file whose verdict is "cannot tell" or "not enough data" fits only if it applies no branch. Limits are those of
    what is applied.

    Parameters
    ----------
    parameters : VehicleParameters
        From :func:`~ecu_node.parameters.read_parameters`.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle that the node rides in; None: not checked.

    Raises
    ------
    UnfitError
        With the reason that the node then publishes; the message gives both values.
    """
    _check_belongs(parameters, database, vehicle)
    layout = database.layout
    if not abs(parameters.junction_residual.expected_a) <= layout.offset_limit_a:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"an expected Kirchhoff sum of {parameters.junction_residual.expected_a:+.4g} A is beyond the layout's "
            f"limit of offsets, {layout.offset_limit_a:g} A",
        )
    applied = [name for name, branch in parameters.branches.items() if branch.apply]
    if parameters.verdict in _UNDECIDED and applied:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"verdict {parameters.verdict!r}, yet branch {', '.join(map(shown_name, applied))} has 'apply': true; "
            f"nothing was found to apply, calibrate with more drives",
        )
    for name, branch in parameters.branches.items():
        _check_branch(name, branch, layout)


def _check_belongs(parameters: VehicleParameters, database: VehicleDatabase, vehicle: str | None) -> None:
    """Check that parameters were made for this vehicle, layout and DBC."""
    layout = database.layout
    if vehicle is not None and parameters.vehicle != vehicle:
        raise UnfitError(
            Reason.WRONG_VEHICLE, f"parameters are for vehicle {parameters.vehicle!r}, this is {vehicle!r}"
        )
    if parameters.layout.sha256 != layout.digest:
        raise UnfitError(
            Reason.WRONG_LAYOUT,
            f"parameters were made with layout {shown_name(parameters.layout.name)} ({parameters.layout.sha256[:12]}), "
            f"this is {layout.path} ({layout.digest[:12]}); calibrate with this layout; for a file "
            "made by hand print a new 'ecu-node template'",
        )
    if parameters.dbc.sha256 != database.digest:
        raise UnfitError(
            Reason.WRONG_DBC,
            f"parameters were made with DBC {shown_name(parameters.dbc.name)} ({parameters.dbc.sha256[:12]}), "
            f"this is {layout.dbc_path} ({database.digest[:12]}); calibrate with this DBC; for a file "
            "made by hand print a new 'ecu-node template'",
        )


def _check_branch(name: str, branch: BranchParameters, layout: Layout) -> None:
    """Check that the layout has a branch, and that what is applied to it is within the limits."""
    if name not in layout.branch_names:
        raise UnfitError(
            Reason.WRONG_LAYOUT, f"parameters for branch {shown_name(name)!r}, which {layout.path} does not have"
        )
    if abs(branch.delay_s or 0.0) > _LARGEST_DELAY_S:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS, f"branch {name}: delay {branch.delay_s:g} s is beyond {_LARGEST_DELAY_S:g} s"
        )
    if not branch.apply:
        return
    if not abs(branch.drift) <= layout.limits.drift:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"branch {name}: drift {branch.drift:+.4g} is beyond the layout's limit of {layout.limits.drift:g}",
        )
    if not abs(branch.offset_a) <= layout.offset_limit_a:
        raise UnfitError(
            Reason.IMPLAUSIBLE_PARAMETERS,
            f"branch {name}: offset {branch.offset_a:+.4g} A is beyond the layout's limit of "
            f"{layout.offset_limit_a:g} A",
        )
