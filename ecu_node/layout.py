"""Layout: a TOML file that says what the signals of a DBC, or the columns of tables, mean.

It names the branches of the junction with their sign, the inputs, where corrected values go, how messages are
protected, timeouts and limits. All later steps use the names given here; the DBC's own names appear nowhere else.
"""

import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import msgspec

from ecu_node.errors import LayoutError
from ecu_node.fields import field_error, toml_place
from ecu_node.formula import formula_names, parse_formula
from ecu_node.units import AMPERE, WATT, usual_unit
from ecu_node.user_files import UnsuitableFileError, read_user_file, text_digest

__all__ = [
    "MAX_LAYOUT_BYTES",
    "PROFILES",
    "AutosarProfile",
    "Branch",
    "Bus",
    "Contactor",
    "CounterCrc8",
    "Derived",
    "E2EWindow",
    "EndToEnd",
    "Input",
    "Layout",
    "LayoutKeys",
    "Limits",
    "Name",
    "ProfileP01",
    "ProfileP02",
    "ProfileP04",
    "ProfileP05",
    "ProfileP06",
    "ProfileP07",
    "ProfileP11",
    "SignalName",
    "StatusMessage",
    "UnmeasuredLoad",
    "Watch",
    "check_layout",
    "file_digest",
    "layout_of",
    "read_layout",
    "split_signal",
]


Name = Annotated[str, msgspec.Meta(pattern=r"^[_A-Za-z][_A-Za-z0-9]*\Z")]
"""A name without blanks."""
SignalName = Annotated[str, msgspec.Meta(pattern=r"^[^\s\x00-\x1f]([^\x00-\x1f]*[^\s\x00-\x1f])?\Z")]
"""``Message.Signal``, as both are called in the DBC, or ``bus:Message.Signal``; without a DBC a column of a table."""


def split_signal(name: SignalName) -> tuple[str, str]:
    """Split ``Message.Signal`` into its two names; a bus stays with the message."""
    message, _, signal = name.partition(".")
    return message, signal


_DataId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]
_LongDataId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]
_Offset = Annotated[int, msgspec.Meta(ge=0, le=60)]


class E2EWindow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a message is VALID, by the last frames of it."""

    window: Annotated[int, msgspec.Meta(ge=1, le=64)]
    """Frames that are looked at."""
    min_ok: Annotated[int, msgspec.Meta(ge=0, le=64)]
    """Fewest of them that must be intact and new."""
    max_error: Annotated[int, msgspec.Meta(ge=0, le=64)]
    """Most of them that may be corrupt."""


class _Protected(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    messages: Annotated[list[Name], msgspec.Meta(min_length=1)]
    init: E2EWindow = E2EWindow(window=1, min_ok=1, max_error=0)
    """To become VALID at the start."""
    valid: E2EWindow = E2EWindow(window=10, min_ok=1, max_error=3)
    """To stay VALID."""
    invalid: E2EWindow = E2EWindow(window=10, min_ok=3, max_error=1)
    """To become VALID again, also after a silence."""
    max_delta_counter: Annotated[int, msgspec.Meta(ge=1, le=255)] = 3
    """Largest step of the counter between two frames that is used: one more than the frames that may be lost."""


class _WithHeader(_Protected, frozen=True, kw_only=True):
    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    offset: _Offset = 0
    """First byte of the header."""


class ProfileP01(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P01"):
    """AUTOSAR E2E profile 1: CRC-8 and a counter of 4 bits."""

    data_id_mode: Literal["both", "alternating", "low", "nibble"] = "both"
    """Which bytes of the data identifier the CRC covers: profile 1A, 1B, the low one only, 1C."""


class ProfileP02(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P02"):
    """AUTOSAR E2E profile 2: CRC-8 and a counter of 4 bits that selects one of 16 data identifiers."""

    data_id_list: dict[
        str, Annotated[list[Annotated[int, msgspec.Meta(ge=0, le=255)]], msgspec.Meta(min_length=16, max_length=16)]
    ]
    """Data identifiers per message."""


class ProfileP04(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P04"):
    """AUTOSAR E2E profile 4: length, a counter of 16 bits, the data identifier and CRC-32."""

    data_id: dict[str, _LongDataId] = {}
    """Data identifier per message; the message's own identifier where not given."""


class ProfileP05(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P05"):
    """AUTOSAR E2E profile 5: CRC-16 and a counter of 8 bits."""


class ProfileP06(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P06"):
    """AUTOSAR E2E profile 6: CRC-16, length and a counter of 8 bits."""


class ProfileP07(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P07"):
    """AUTOSAR E2E profile 7: CRC-64, length, a counter of 32 bits and the data identifier."""

    data_id: dict[str, _LongDataId] = {}
    """Data identifier per message; the message's own identifier where not given."""


class ProfileP11(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P11"):
    """AUTOSAR E2E profile 11: CRC-8 and a counter of 4 bits, as profile 1 on the bus."""

    data_id_mode: Literal["both", "nibble"] = "both"
    """Which bits of the data identifier the CRC covers: both bytes (11A), or 12 bits, of which 4 are sent (11C)."""


class CounterCrc8(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="counter CRC8"):
    """A counter and a CRC-8 as signals of the DBC; the CRC covers all bytes but its own."""

    counter: Name
    crc: Name
    algorithm: str = "sae_j1850"
    """As fastcrc names it."""
    counter_modulus: Annotated[int, msgspec.Meta(ge=2, le=65536)] | None = None
    """Number of codes of the counter, which runs from 0; all that fit the signal where not given."""
    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    data_id_bytes: Literal[0, 1, 2] = 0
    """How many of its bytes the CRC covers too, the low one first."""
    data_id_at: Literal["before", "after"] = "before"
    """Whether they come before or after the payload."""


AutosarProfile = ProfileP01 | ProfileP02 | ProfileP04 | ProfileP05 | ProfileP06 | ProfileP07 | ProfileP11
"""A profile of AUTOSAR for some messages."""
EndToEnd = AutosarProfile | CounterCrc8
"""How some messages are protected."""

PROFILES = ("P01", "P02", "P04", "P05", "P06", "P07", "P11", "counter CRC8")
"""Values of ``profile``."""


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
    vss: str | None = None
    """Its name in the COVESA Vehicle Signal Specification, used in telemetry."""
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
    sleep_s: Annotated[float, msgspec.Meta(ge=0.0, le=3600.0)] = 5.0
    """The bus sleeps once all branches have been silent for so long; shorter gaps release nothing. [s]"""
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
        raise LayoutError(
            f"{path}: not a layout: the file is not UTF-8 text; see the page 'Layout' of the documentation"
        ) from None
    except (ValueError, RecursionError) as error:  # not only TOMLDecodeError: numbers and nesting have limits, too
        raise LayoutError(
            f"{path}: not TOML: {error}; a layout is expected, see the page 'Layout' of the documentation"
        ) from None
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
        raise LayoutError(f"{path}: {why}; see the page 'Layout' of the documentation") from None
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
                f"see the page 'Layout' of the documentation"
            )


def check_layout(layout: "LayoutKeys", path: Path) -> None:
    """Check a layout as a whole.

    Parameters
    ----------
    layout : LayoutKeys
        Each of its keys is right by itself.
    path : Path
        Where it was read from.

    Raises
    ------
    LayoutError
        If two keys contradict each other, or one names what the layout does not have.
    """

    def refuse(text: str) -> NoReturn:
        raise LayoutError(f"{path}: {text}")

    names = [*layout.branch_names, *(item.name for item in layout.input), *(item.name for item in layout.derived)]
    twice = _repeated(names)
    if twice:
        refuse(f"{', '.join(twice)} is named twice; branches, inputs and derived inputs need different names")
    for branch in layout.branch:
        _check_branch(branch, refuse)
    if sum(branch.balance for branch in layout.branch) > 1:
        refuse("more than one branch has 'balance = true'; at most one can take what the others leave")
    _check_buses(layout, refuse)
    _check_signals(layout, refuse)
    _check_inputs(layout, refuse)
    _check_protection(layout, refuse)


def _check_protection(layout: "LayoutKeys", refuse: Callable[[str], NoReturn]) -> None:
    places: dict[str, str] = {}
    for place, entry in layout.protections:
        for name in entry.messages:
            if name in places:
                how = "is named twice" if places[name] == place else f"stands in {places[name]} too"
                refuse(f"{place}, messages: {name} {how}; a message has one protection")
            places[name] = place
        given = entry.data_id_list if isinstance(entry, ProfileP02) else entry.data_id
        key = "data_id_list" if isinstance(entry, ProfileP02) else "data_id"
        if unknown := [name for name in given if name not in entry.messages]:
            refuse(f"{place}, {key}: {', '.join(unknown)} is not in 'messages'; add it there, or leave its {key} out")
        if isinstance(entry, ProfileP02) and (missing := [name for name in entry.messages if name not in given]):
            refuse(f"{place}, {key}: {', '.join(missing)} has none; profile P02 needs 16 numbers per message")


def _check_buses(layout: "LayoutKeys", refuse: Callable[[str], NoReturn]) -> None:
    """Refuse names of signals that the databases of the layout, or their absence, do not allow."""
    if layout.dbc is not None and layout.bus:
        refuse("give either 'dbc', or [[bus]] with a 'dbc' each")
    for what in ("name", "channel"):
        if twice := _repeated([getattr(bus, what) for bus in layout.bus]):
            refuse(f"[[bus]] {what}: {', '.join(twice)} stands there twice; each bus needs one of its own")
    if not layout.dbc_files:
        outputs = [f"branch {item.name}: 'corrected'" for item in layout.branch if item.corrected is not None]
        outputs += ["[e2e]"] if layout.protections else []
        outputs += ["[status]"] if layout.status is not None else []
        if outputs:
            refuse(f"{outputs[0]} names messages, but the layout has no 'dbc'; give it, or leave this out")
        return
    known = {bus.name for bus in layout.bus}
    items: list[Branch | Input] = [*layout.branch, *layout.input]
    for item in items:
        for key in ("signal", "power", "voltage", "corrected", "quality"):
            name = getattr(item, key, None)
            if name is None:
                continue
            bus, has_bus, bare = name.rpartition(":")
            place = f"[[{'branch' if item in layout.branch else 'input'}]] {item.name!r}, {key}"
            if re.fullmatch(r"[^.\s]+\.[^.\s]+", bare) is None:
                refuse(
                    f"{place}: 'Message.Signal' as in the DBC is expected, found \"{name}\"; see the page "
                    "'Layout' of the documentation"
                )
            if has_bus and bus not in known:
                refuse(f"{place}: no [[bus]] is named {bus!r}; known are {', '.join(sorted(known)) or 'none'}")


def _repeated(names: Sequence[str]) -> list[str]:
    return sorted({name for name in names if names.count(name) > 1})


def _check_signals(layout: "LayoutKeys", refuse: Callable[[str], NoReturn]) -> None:
    """Refuse one signal for two branches, for two outputs, or for both reading and writing."""
    for name in _repeated([branch.source for branch in layout.branch]):
        sharing = " and ".join(branch.name for branch in layout.branch if branch.source == name)
        refuse(f"branches {sharing}: both read {name}; each branch needs a signal of its own")
    for name in _repeated([branch.vss for branch in layout.branch if branch.vss is not None]):
        refuse(f"vss {name!r} stands at two branches; each needs a name of its own")
    outputs = [name for branch in layout.branch for name in (branch.corrected, branch.quality) if name is not None]
    for name in _repeated(outputs):
        writing = " and ".join(branch.name for branch in layout.branch if name in (branch.corrected, branch.quality))
        refuse(f"branch {writing}: {name} is written twice; each 'corrected' and 'quality' needs a signal of its own")
    read = {name for branch in layout.branch for name in (branch.signal, branch.power, branch.voltage)}
    read |= {item.signal for item in layout.input}
    for branch in layout.branch:
        for output in (branch.corrected, branch.quality):
            if output is not None and output in read:
                refuse(f"branch {branch.name}: {output} is both read and written; give the output a signal of its own")


def _check_inputs(layout: "LayoutKeys", refuse: Callable[[str], NoReturn]) -> None:
    known = {item.name for item in layout.input}
    for item in layout.derived:
        if unknown := _unknown_names(item.formula, known, f"derived input {item.name}", refuse):
            refuse(f"derived input {item.name}: {', '.join(unknown)} is no input or derived input declared above it")
        known.add(item.name)
    for branch in layout.branch:
        if branch.formula is None:
            continue
        unknown = _unknown_names(branch.formula, known, f"branch {branch.name}", refuse)
        if unknown and layout.dbc_files:
            refuse(
                f"branch {branch.name}: {', '.join(unknown)} is no [[input]] or [[derived]]; declare the signal as one"
            )
    if layout.contactor is not None and layout.contactor.input not in {item.name for item in layout.input}:
        refuse(f"[contactor] input: {layout.contactor.input!r} is no [[input]]; declare the signal as one")
    if layout.temperature is not None and layout.temperature not in {item.name for item in layout.input}:
        refuse(f"temperature: {layout.temperature!r} is no [[input]]; declare the signal as one, or leave the key out")
    watch = layout.watch
    if watch.input is not None and watch.input not in {item.name for item in layout.input}:
        refuse(f"[watch] input: {watch.input!r} is no [[input]]; declare the signal as one")
    if (watch.input is None) != (not watch.valid):
        refuse("[watch]: give both 'input' and 'valid', or neither")
    for key, names in (("model_inputs", layout.model_inputs), ("fleet_inputs", layout.fleet_inputs)):
        unknown = [name for name in names if name not in known]
        if unknown:
            refuse(f"{key}: {', '.join(unknown)} is no [[input]] or [[derived]]")


def _unknown_names(formula: str, known: set[str], where: str, refuse: Callable[[str], NoReturn]) -> list[str]:
    """Names in a formula that are not known."""
    try:
        names = formula_names(parse_formula(formula))
    except LayoutError as error:
        refuse(f"{where}: {error}")
    return [name for name in names if name not in known]


def _check_branch(branch: "Branch", refuse: Callable[[str], NoReturn]) -> None:
    ways = (branch.signal, branch.power, branch.formula)
    if sum(way is not None for way in ways) != 1 or (branch.power is None) != (branch.voltage is None):
        refuse(f"branch {branch.name}: give either 'signal' (a current), 'power' and 'voltage', or 'formula'")
    if branch.formula is not None and (branch.corrected is not None or branch.unit is not None):
        refuse(f"branch {branch.name}: 'formula' gives A and is not written; leave out 'corrected' and 'unit'")
    if branch.formula is None and branch.uncertainty:
        refuse(f"branch {branch.name}: 'uncertainty' is that of a 'formula'; a sensor's is what is estimated")
    known = {*AMPERE} if branch.signal is not None else {*WATT}
    if branch.unit is not None and usual_unit(branch.unit) not in known:
        refuse(f"branch {branch.name}: unit {branch.unit!r} is unknown; expected {', '.join(sorted(known))}")
    if branch.vss is not None and re.fullmatch(r"Vehicle(\.[A-Z][A-Za-z0-9]*)+", branch.vss) is None:
        refuse(
            f"branch {branch.name}: vss {branch.vss!r}: expected a name of the Vehicle Signal Specification, such as "
            "'Vehicle.Powertrain.TractionBattery.CurrentCurrent'"
        )
    if branch.quality is not None and branch.corrected is None:
        refuse(f"branch {branch.name}: 'quality' without 'corrected'")
    if branch.quality and branch.corrected and split_signal(branch.quality)[0] != split_signal(branch.corrected)[0]:
        refuse(f"branch {branch.name}: 'quality' and 'corrected' must be signals of one message")
