"""Layout: a TOML file that says what the signals of a DBC, or the columns of tables, mean.

It names the branches of the junction with their sign, the inputs, where corrected values go, timeouts and limits.
All later steps use the names given here; the DBC's own names appear nowhere else.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ecu_node.errors import LayoutError
from ecu_node.field_errors import field_error, toml_place
from ecu_node.layout_checks import check_layout
from ecu_node.layout_e2e import PROFILES, EndToEnd
from ecu_node.signal_names import Name, SignalName, split_signal
from ecu_node.user_files import UnsuitableFileError, read_user_file, text_digest

__all__ = [
    "MAX_LAYOUT_BYTES",
    "Branch",
    "Bus",
    "Contactor",
    "Derived",
    "Input",
    "Layout",
    "LayoutKeys",
    "Limits",
    "Name",
    "SignalName",
    "StatusMessage",
    "UnmeasuredLoad",
    "Watch",
    "file_digest",
    "layout_of",
    "read_layout",
    "split_signal",
]

MAX_LAYOUT_BYTES = 1_000_000
"""A layout has some kilobytes; a larger file is not one."""

_Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]


class Bus(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One of the buses that a log holds."""

    name: Name
    channel: str
    """As the log calls it, such as ``can0``."""
    dbc: str
    """Path of its DBC, relative to the layout file."""


class Branch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One HV current at the junction: a current, a power divided by a voltage, or computed by a formula [A]."""

    name: Name
    sign: Literal[1, -1]
    """+1 if the signal is positive into the junction, -1 if positive out of it."""
    signal: SignalName | None = None
    power: SignalName | None = None
    voltage: SignalName | None = None
    formula: str | None = None
    """Of inputs and derived inputs, and without a DBC of columns; its value is the current. [A]"""
    unit: str | None = None
    """Of the current or power, where DBC or header do not say it or are wrong."""
    uncertainty: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    """Relative standard deviation of what a formula gives. [1]"""
    timeout_s: _Positive = 0.5
    """Without a frame for this long the branch is stale. [s]"""
    balance: bool = False
    """In ground truth made from recordings, this branch is minus the sum of the others, (19) of the paper."""
    corrected: SignalName | None = None
    quality: SignalName | None = None
    no_value: list[int] = []
    """Raw codes of the signal that are no values, beyond those that the DBC names."""

    @property
    def computed(self) -> bool:
        """Whether a formula gives the current: a poor reference for sensors."""
        return self.formula is not None

    @property
    def source(self) -> SignalName:
        """The signal whose frames carry this branch; of a computed one the formula."""
        source = self.signal or self.power or self.formula
        assert source is not None
        return source


class Input(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One signal that the vehicle model may be driven by."""

    name: Name
    signal: SignalName


class Derived(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One input computed from others at each instant of the aligned time base."""

    name: Name
    formula: str


class Contactor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which input tells that the contactors are open, so that no HV current flows."""

    input: Name
    open: Annotated[list[float], msgspec.Meta(min_length=1)]
    """Values of the input that mean open."""


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Largest parameters that the node accepts."""

    drift: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.4
    """Largest magnitude of a drift. [1]"""
    offset_a: _Positive | None = None
    """Largest magnitude of an offset [A]; 40 % of full scale where not given."""


class UnmeasuredLoad(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What flows out of the junction where no branch measures it, as control units take it."""

    mean_a: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
    """Mean over vehicles. [A]"""
    sd_a: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
    """Standard deviation over vehicles. [A]"""


class StatusMessage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The message in which the node reports itself, and its signals."""

    message: Name
    period_s: _Positive = 0.1
    state: Name
    reason: Name
    parameter_set: Name | None = None
    alive_counter: Name | None = None
    """Counts the status messages; for those without a counter by [e2e]."""
    sum_measured: Name | None = None
    sum_corrected: Name | None = None


class Watch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When the node holds its own corrections for wrong."""

    window_s: Annotated[float, msgspec.Meta(ge=1.0, le=3600.0)] = 10.0
    """Over this long the sums are compared. [s]"""
    margin_a: _Positive | None = None
    """By how much the corrected sum must be worse (RMS) [A]; 0.25 % of full scale where not given."""
    start_s: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 3.0
    """So long after the bus has woken up the first frame of a branch may come, if its timeout is shorter. [s]"""
    input: Name | None = None
    """Input that tells whether all currents of the junction are measured, as they may not be while it is charged."""
    valid: list[float] = []
    """Its values with which they are; the sums of other times are not judged."""


class Activation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What it takes until signed parameters are in force."""

    trial_s: Annotated[float, msgspec.Meta(ge=1.0, le=86400.0)] = 300.0
    """So long the Kirchhoff sum is watched, while currents flow. [s]"""
    tolerance: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5
    """By so much the share of the corrections that were errors may be below what the calibrator saw. [1]"""
    step_drift: Annotated[float, msgspec.Meta(gt=0.0, le=2.0)] = 0.2
    """Largest difference from the drift that is in force. [1]"""
    step_offset_a: _Positive | None = None
    """Largest difference from the offset that is in force [A]; 20 % of full scale where not given."""


class LayoutKeys(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a layout file may say."""

    schema: Literal[1]
    name: Name
    dbc: str | None = None
    """Path of the DBC, relative to the layout file; not given where the recordings are tables."""
    bus: list[Bus] = []
    """In place of the DBC, where logs hold several buses."""
    full_scale_a: _Positive
    branch: Annotated[list[Branch], msgspec.Meta(min_length=2, max_length=16)]
    period_s: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = 0.1
    max_age_s: _Positive = 1.0
    """An input without a frame for this long is stale. [s]"""
    input: list[Input] = []
    wrong_ranges: list[SignalName] = []
    """Signals whose [minimum|maximum] in the DBC is wrong: it is not applied to them."""
    temperature: Name | None = None
    """Input that is the temperature of the current sensors. [degC]"""
    contactor: Contactor | None = None
    derived: list[Derived] = []
    model_inputs: list[str] = []
    """What the model of one vehicle is driven by."""
    fleet_inputs: list[str] = []
    """What the model of the whole fleet is driven by; the model inputs where not given."""
    unmeasured_load: UnmeasuredLoad | None = None
    """If it is known; where not given, it is estimated from the fleet."""
    limits: Limits = Limits()
    status: StatusMessage | None = None
    e2e: EndToEnd | list[EndToEnd] = []
    """One profile is a table, several are a list of tables."""
    on_bad_frame: Literal["hold", "invalid"] = "hold"
    """What the node makes of a frame that fails its check: nothing, or one that is seen to be invalid."""
    watch: Watch = Watch()
    activation: Activation = Activation()

    @property
    def dbc_files(self) -> dict[str, str]:
        """DBC files as written, by bus; ``""`` where the layout names none."""
        return {bus.name: bus.dbc for bus in self.bus} or ({} if self.dbc is None else {"": self.dbc})

    @property
    def branch_names(self) -> tuple[str, ...]:
        """Names of the branches in the order of the file."""
        return tuple(branch.name for branch in self.branch)

    @property
    def offset_limit_a(self) -> float:
        """Largest magnitude of an offset that the node accepts. [A]"""
        return self.limits.offset_a if self.limits.offset_a is not None else 0.4 * self.full_scale_a

    @property
    def step_offset_a(self) -> float:
        """Largest difference of an offset from the one that is in force. [A]"""
        given = self.activation.step_offset_a
        return given if given is not None else 0.2 * self.full_scale_a

    @property
    def watch_margin_a(self) -> float:
        """By how much the corrected sum must be worse than the measured one. [A]"""
        return self.watch.margin_a if self.watch.margin_a is not None else 0.0025 * self.full_scale_a

    @property
    def protections(self) -> list[tuple[str, EndToEnd]]:
        """All entries of how messages are protected, each with its place in the file."""
        if not isinstance(self.e2e, list):
            return [("[e2e]", self.e2e)]
        return [(f"[[e2e]] entry number {number}", entry) for number, entry in enumerate(self.e2e, start=1)]

    def protection(self, message: str) -> EndToEnd | None:
        """How a message is protected; None if it is not."""
        return next((entry for _, entry in self.protections if message in entry.messages), None)

    def protection_place(self, message: str) -> str:
        """Where the file says how a message is protected, which it does."""
        return next(place for place, entry in self.protections if message in entry.messages)


class Layout(LayoutKeys, frozen=True, kw_only=True):
    """A whole layout file, checked."""

    path: Path
    """Where it was read from."""
    digest: str
    """SHA-256 of the file."""

    @property
    def dbc_path(self) -> Path:
        """Path of the DBC file, of several the first; no file's name where there is none."""
        return next(iter(self.dbc_paths.values()), Path("no DBC"))

    @property
    def dbc_paths(self) -> dict[str, Path]:
        """Paths of the DBC files by bus, ``""`` where the layout names none."""
        return {bus: self.path.parent / file for bus, file in self.dbc_files.items()}

    @property
    def dbc_digest(self) -> str:
        """SHA-256 of the DBC file, of several of their digests one after the other, without one of nothing."""
        digests = [file_digest(path) for path in self.dbc_paths.values()]
        return digests[0] if len(digests) == 1 else text_digest("".join(digests).encode())

    def find_branch(self, name: str) -> Branch:
        """Return the branch of this name; LayoutError lists the known ones if there is none."""
        for branch in self.branch:
            if branch.name == name:
                return branch
        raise LayoutError(f"{self.path}: no branch {name!r}; known are {', '.join(self.branch_names)}")


def read_layout(path: Path) -> Layout:
    """Read and check a layout file.

    Parameters
    ----------
    path : Path
        The TOML file. The DBC it names is not opened here.

    Returns
    -------
    Layout
        The checked layout, with its path and digest.

    Raises
    ------
    LayoutError
        If the file cannot be read, is not TOML, or a field is missing, unknown or contradictory.
    """
    try:
        content = read_user_file(path, largest_bytes=MAX_LAYOUT_BYTES)
        document = tomllib.loads(content.decode())
    except (OSError, UnsuitableFileError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise LayoutError(f"{path}: cannot read the layout: {why}; name the layout (TOML) of this vehicle") from None
    except UnicodeDecodeError:
        raise LayoutError(f"{path}: not a layout: the file is not UTF-8 text; see docs/layout.md") from None
    except (ValueError, RecursionError) as error:  # not only TOMLDecodeError: numbers and nesting have limits, too
        raise LayoutError(f"{path}: not TOML: {error}; a layout is expected, see docs/layout.md") from None
    return layout_of(document, path, text_digest(content))


def layout_of(document: dict[str, Any], path: Path, digest: str | None = None) -> Layout:
    """Check a layout.

    Parameters
    ----------
    document : dict
        What a layout file says.
    path : Path
        Where it stands, for messages and for the DBC.
    digest : str, optional
        Of the file; of the document where it stands in none.

    Returns
    -------
    Layout
        The checked layout.

    Raises
    ------
    LayoutError
        If a field is missing, unknown or contradictory.
    """
    _require_profiles(document, path)
    try:
        keys = msgspec.convert(document, LayoutKeys)
    except msgspec.ValidationError as error:
        why = field_error(error, document, LayoutKeys, toml_place)
        raise LayoutError(f"{path}: {why}; see docs/layout.md") from None
    check_layout(keys, path)
    return Layout(
        **msgspec.structs.asdict(keys), path=path, digest=digest or text_digest(msgspec.json.encode(document))
    )


def file_digest(path: Path) -> str:
    """SHA-256 of a text file, the same for LF and CRLF line ends."""
    return text_digest(path.read_bytes())


def _require_profiles(document: dict[str, Any], path: Path) -> None:
    """Refuse an unknown profile: what else an entry may say depends on it."""
    found = document.get("e2e", [])
    places = [("e2e", number) for number in range(len(found))] if isinstance(found, list) else [("e2e",)]
    for steps, entry in zip(places, found if isinstance(found, list) else [found], strict=True):
        if isinstance(entry, dict) and entry.get("profile") not in PROFILES:
            what = f"found {entry['profile']!r}" if "profile" in entry else "it is missing"
            raise LayoutError(
                f"{path}: {toml_place(document, steps)}, profile: one of {', '.join(PROFILES)} is expected, {what}; "
                f"see docs/layout.md"
            )
