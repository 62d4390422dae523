"""Layout: a TOML file that says what the signals of a DBC, or the columns of tables, mean.

It names the branches of the junction with their sign, the inputs, where corrected values go, how messages are
protected, timeouts and limits. All later steps use the names given here; the DBC's own names appear nowhere else.
"""

import tomllib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ecu_node.documents import field_error, read_user_file, text_digest
from ecu_node.errors import LayoutError, printable
from ecu_node.formulas import formula_names, parse_formula

__all__ = [
    "LONGEST_PERIOD_S",
    "AutosarProfile",
    "Branch",
    "Contactor",
    "CounterCrc8",
    "E2EWindow",
    "EndToEnd",
    "Input",
    "Layout",
    "LayoutKeys",
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
    "file_digest",
    "joint_digest",
    "layout_of",
    "read_layout",
    "split_signal",
]

Name = Annotated[str, msgspec.Meta(pattern=r"^[_A-Za-z][_A-Za-z0-9]*\Z", description="a name of letters, digits and _")]
"""A name of letters, digits and underscores."""
SignalName = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[^\s\x00-\x1f]([^\x00-\x1f]*[^\s\x00-\x1f])?\Z",
        description="'Message.Signal' as in the DBC, or a column without blanks at its ends,",
    ),
]
"""``Message.Signal``, as both are called in the DBC, or ``bus:Message.Signal``; without a DBC a column of a table."""


def split_signal(name: SignalName) -> tuple[str, str]:
    """Split ``Message.Signal`` into its two names; a prefix ``bus:`` stays with the message."""
    message, _, signal = name.partition(".")
    return message, signal


LONGEST_PERIOD_S = 900.0
"""Longest period that is accepted: loggers of solar plants write a row every quarter of an hour. [s]"""


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the layout file; unknown keys are refused."""


_MAX_LAYOUT_BYTES = 1_000_000
"""A layout has some kilobytes; a larger file is not one."""

_Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]
_Finite = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]
_VssName = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^Vehicle(\.[A-Z][A-Za-z0-9]*)+\Z",
        description="a name of the Vehicle Signal Specification, such as Vehicle.Powertrain.TractionBattery.Power,",
    ),
]


class Bus(_Table, frozen=True, kw_only=True):
    """One of the buses that a log holds."""

    name: Name
    channel: str
    """Name of its channel in the log, such as ``can0``."""
    dbc: str
    """Path of its DBC, relative to the layout file."""


class Branch(_Table, frozen=True, kw_only=True):
    """One HV current at the junction, given by a current signal, by a power and a voltage, or by a formula."""

    name: Name
    sign: Literal[1, -1]
    """+1 if the signal is positive into the junction, -1 if positive out of it."""
    signal: SignalName | None = None
    power: SignalName | None = None
    voltage: SignalName | None = None
    formula: str | None = None
    """Formula that gives the current [A] from inputs and derived inputs, or from columns if there is no DBC. Only the
    calibrator reads formulas; the node needs none."""
    unit: str | None = None
    """Unit of the current or power, if DBC or header do not give it or give a wrong one."""
    uncertainty: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    """Relative standard deviation of what a formula gives. [1]"""
    timeout_s: _Positive = 0.5
    """Without a frame for this long the branch is stale. [s]"""
    balance: bool = False
    """In ground truth made from recordings, this branch is set to minus the sum of the others: equation (19) of the
    paper."""
    corrected: SignalName | None = None
    """Signal into which an overlay node writes the corrected current or power."""
    quality: SignalName | None = None
    """Signal of the same message that says what kind of value that is, such as corrected or passed through."""
    vss: _VssName | None = None
    """Its name in the COVESA Vehicle Signal Specification, used in telemetry."""
    no_value: list[int] = []
    """Raw codes of the signal that are no values, besides those that the DBC names."""

    @property
    def computed(self) -> bool:
        """Whether a formula gives the current, which makes it a poor reference for sensors."""
        return self.formula is not None

    @property
    def source(self) -> SignalName:
        """The signal whose frames carry this branch; the formula if the branch is computed."""
        source = self.signal or self.power or self.formula
        assert source is not None
        return source


class Input(_Table, frozen=True, kw_only=True):
    """One signal besides the currents: an input of the vehicle model, a contactor state, a temperature ..."""

    name: Name
    signal: SignalName


class Derived(_Table, frozen=True, kw_only=True):
    """One input computed from others at each instant of the aligned time base."""

    name: Name
    formula: str


class Contactor(_Table, frozen=True, kw_only=True):
    """The input that shows when the contactors are open, so that no HV current flows."""

    input: Name
    open: Annotated[list[_Finite], msgspec.Meta(min_length=1)]
    """Values of the input that mean open."""


class Limits(_Table, frozen=True, kw_only=True):
    """Largest parameters that the node accepts."""

    drift: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.4
    """Largest magnitude of a drift. [1]"""
    offset_a: _Positive | None = None
    """Largest magnitude of an offset [A]; 40 % of full scale where not given."""


class UnmeasuredLoad(_Table, frozen=True, kw_only=True):
    """Current that flows out of the junction where no branch measures it, such as that of control units."""

    mean_a: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
    """Mean over vehicles. [A]"""
    sd_a: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
    """Standard deviation over vehicles. [A]"""


class StatusMessage(_Table, frozen=True, kw_only=True):
    """The message in which the node reports itself, and its signals."""

    message: Name
    period_s: Annotated[float, msgspec.Meta(ge=0.01, le=1e6)] = 0.1
    state: Name
    reason: Name
    parameter_set: Name | None = None
    alive_counter: Name | None = None
    """Signal that counts the status messages, for a message that has no counter by [e2e]."""
    sum_measured: Name | None = None
    sum_corrected: Name | None = None

    @property
    def signals(self) -> dict[str, SignalName]:
        """The signals that it has, as ``Message.Signal``, by the keys ``state`` to ``sum_corrected``."""
        keys = ("state", "reason", "parameter_set", "alive_counter", "sum_measured", "sum_corrected")
        names = {key: getattr(self, key) for key in keys}
        return {key: f"{self.message}.{name}" for key, name in names.items() if name is not None}


class Watch(_Table, frozen=True, kw_only=True):
    """When the node takes its corrections for wrong, a branch for missing, and the bus for asleep."""

    window_s: Annotated[float, msgspec.Meta(ge=1.0, le=3600.0)] = 10.0
    """Measured and corrected sums are compared over this long. [s]"""
    margin_a: _Positive | None = None
    """The correction is wrong if the corrected sum (RMS) exceeds the measured one by this [A]; where not given, 0.25 %
    of full scale."""
    start_s: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 3.0
    """Time that the first frame of a branch may take after the bus has woken up, if its timeout is shorter. [s]"""
    sleep_s: Annotated[float, msgspec.Meta(ge=0.0, le=3600.0)] = 5.0
    """The bus sleeps once all branches have been silent for this long; shorter gaps release nothing. [s]"""
    input: Name | None = None
    """Input that shows whether all currents of the junction are measured, as may not be so during charging."""
    valid: list[_Finite] = []
    """Its values while all currents are measured; at other times the sums are not judged."""


class Activation(_Table, frozen=True, kw_only=True):
    """What signed parameters must fulfil to be put in force: their trial, and their largest step."""

    trial_s: Annotated[float, msgspec.Meta(ge=1.0, le=86400.0)] = 300.0
    """Length of the trial: time for which the Kirchhoff sum is watched while currents flow. [s]"""
    tolerance: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5
    """How far the share in :mod:`ecu_node.update.trial` may fall below that which the calibrator saw. [1]"""
    step_drift: Annotated[float, msgspec.Meta(gt=0.0, le=2.0)] = 0.2
    """Largest difference of a new drift from that in force. [1]"""
    step_offset_a: _Positive | None = None
    """Largest difference of a new offset from that in force [A]; 20 % of full scale where not given."""


_DataId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]
_LongDataId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]
_Offset = Annotated[int, msgspec.Meta(ge=0, le=60)]


class E2EWindow(_Table, frozen=True, kw_only=True):
    """Condition on the last frames of a message under which it is VALID."""

    window: Annotated[int, msgspec.Meta(ge=1, le=64)]
    """Number of last frames that are looked at."""
    min_ok: Annotated[int, msgspec.Meta(ge=0, le=64)]
    """Fewest of them that must be intact and new."""
    max_error: Annotated[int, msgspec.Meta(ge=0, le=64)]
    """Most of them that may be corrupt."""


class _Protected(_Table, frozen=True, kw_only=True):
    """Keys that all kinds of protection share."""

    messages: Annotated[list[Name], msgspec.Meta(min_length=1)]
    init: E2EWindow = E2EWindow(window=1, min_ok=1, max_error=0)
    """Condition to become VALID at the start."""
    valid: E2EWindow = E2EWindow(window=10, min_ok=1, max_error=3)
    """Condition to stay VALID."""
    invalid: E2EWindow = E2EWindow(window=10, min_ok=3, max_error=1)
    """Condition to become VALID again, also after a silence."""
    max_delta_counter: Annotated[int, msgspec.Meta(ge=1, le=255)] = 3
    """Largest step of the counter after which a frame is still used: 3 allows for two lost frames before it."""

    @property
    def profile(self) -> str:
        """Name of the profile, as in the file."""
        return str(self.__struct_config__.tag)


class _WithHeader(_Protected, frozen=True, kw_only=True):
    """Keys of the AUTOSAR profiles with one data identifier and a header that can be moved."""

    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    offset: _Offset = 0
    """First byte of the header."""


class _WithLongDataId(_WithHeader, frozen=True, kw_only=True):
    data_id: dict[str, _LongDataId] = {}
    """Data identifier per message; the message's own identifier where not given."""


class ProfileP01(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P01"):
    """AUTOSAR E2E profile 1: CRC-8 and a counter of 4 bits."""

    data_id_mode: Literal["both", "alternating", "low", "nibble"] = "both"
    """Which bytes of the data identifier the CRC covers: "both" as in profile 1A, "alternating" as in 1B, "nibble" as
    in 1C, "low" the low byte only."""


class ProfileP02(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P02"):
    """AUTOSAR E2E profile 2: CRC-8 and a counter of 4 bits that selects one of 16 data identifiers."""

    data_id_list: dict[
        str, Annotated[list[Annotated[int, msgspec.Meta(ge=0, le=255)]], msgspec.Meta(min_length=16, max_length=16)]
    ]
    """Data identifiers of each message: 16 numbers, one for each code of the counter."""


class ProfileP04(_WithLongDataId, frozen=True, kw_only=True, tag_field="profile", tag="P04"):
    """AUTOSAR E2E profile 4: length, a counter of 16 bits, the data identifier and CRC-32."""


class ProfileP05(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P05"):
    """AUTOSAR E2E profile 5: CRC-16 and a counter of 8 bits."""


class ProfileP06(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P06"):
    """AUTOSAR E2E profile 6: CRC-16, length and a counter of 8 bits."""


class ProfileP07(_WithLongDataId, frozen=True, kw_only=True, tag_field="profile", tag="P07"):
    """AUTOSAR E2E profile 7: CRC-64, length, a counter of 32 bits and the data identifier."""


class ProfileP11(_WithHeader, frozen=True, kw_only=True, tag_field="profile", tag="P11"):
    """AUTOSAR E2E profile 11: CRC-8 and a counter of 4 bits, as profile 1 on the bus."""

    data_id_mode: Literal["both", "nibble"] = "both"
    """Which bits of the data identifier the CRC covers: both bytes (11A), or 12 bits, of which 4 are sent (11C)."""


class CounterCrc8(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="counter CRC8"):
    """A counter and a CRC-8 as signals of the DBC; the CRC covers all bytes but its own."""

    counter: Name
    crc: Name
    algorithm: str = "sae_j1850"
    """Name of the CRC-8 in fastcrc."""
    counter_modulus: Annotated[int, msgspec.Meta(ge=2, le=65536)] | None = None
    """Number of codes of the counter, which runs from 0; all that fit into the signal if not given."""
    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    data_id_bytes: Literal[0, 1, 2] = 0
    """How many bytes of the data identifier the CRC covers too, the low one first."""
    data_id_at: Literal["before", "after"] = "before"
    """Whether the CRC takes these bytes before or after the payload."""


AutosarProfile = ProfileP01 | ProfileP02 | ProfileP04 | ProfileP05 | ProfileP06 | ProfileP07 | ProfileP11
"""A profile of AUTOSAR for some messages."""
EndToEnd = AutosarProfile | CounterCrc8
"""One way to protect messages: a profile of AUTOSAR, or a counter with a CRC-8."""


class LayoutKeys(_Table, frozen=True, kw_only=True):
    """What a layout file may say."""

    schema: Literal[1]
    name: Name
    dbc: str | None = None
    """Path of the DBC, relative to the layout file; not given where the recordings are tables."""
    bus: list[Bus] = []
    """Buses, each with its DBC, in place of ``dbc`` if logs hold several buses."""
    full_scale_a: _Positive
    """Nominal maximum current of the junction. [A]"""
    branch: Annotated[list[Branch], msgspec.Meta(min_length=2, max_length=16)]
    period_s: Annotated[float, msgspec.Meta(gt=0.0, le=LONGEST_PERIOD_S)] = 0.1
    """Period of the time base on which the calibrator compares all currents and inputs. [s]"""
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
    """Inputs of the model of one vehicle."""
    fleet_inputs: list[str] = []
    """Inputs of the model of the whole fleet; ``model_inputs`` if not given."""
    unmeasured_load: UnmeasuredLoad | None = None
    """Current that no branch measures, if it is known; if not given, it is estimated from the fleet."""
    limits: Limits = Limits()
    status: StatusMessage | None = None
    e2e: EndToEnd | list[EndToEnd] = []
    """How messages are protected: one profile is a table, several are a list of tables."""
    watch: Watch = Watch()
    activation: Activation = Activation()

    @property
    def dbc_files(self) -> dict[str, str]:
        """DBC files as written, by name of the bus (``""`` if the layout names no buses); empty if it has no DBC."""
        return {bus.name: bus.dbc for bus in self.bus} or ({} if self.dbc is None else {"": self.dbc})

    @property
    def watch_signal(self) -> SignalName | None:
        """The signal of the watch's input; None if the watch has no input."""
        return next((item.signal for item in self.input if item.name == self.watch.input), None)

    @property
    def branch_names(self) -> tuple[str, ...]:
        """Names of the branches in the order of the file."""
        return tuple(branch.name for branch in self.branch)

    @property
    def offset_limit_a(self) -> float:
        """Largest magnitude of an offset that the node accepts. [A]"""
        return self.limits.offset_a or 0.4 * self.full_scale_a

    @property
    def step_offset_a(self) -> float:
        """Largest difference of a new offset from that in force. [A]"""
        return self.activation.step_offset_a or 0.2 * self.full_scale_a

    @property
    def watch_margin_a(self) -> float:
        """By how much the corrected sum must be worse than the measured one for the node to stop correcting. [A]"""
        return self.watch.margin_a or 0.0025 * self.full_scale_a

    @property
    def protections(self) -> list[tuple[str, EndToEnd]]:
        """All entries of ``e2e``, each after its place in the file, such as ``[[e2e]] entry number 2``."""
        if not isinstance(self.e2e, list):
            return [("[e2e]", self.e2e)]
        return [(f"[[e2e]] entry number {number}", entry) for number, entry in enumerate(self.e2e, start=1)]

    def protection(self, message: str) -> EndToEnd | None:
        """Return how the message of this name is protected; None if it is not."""
        return next((entry for _, entry in self.protections if message in entry.messages), None)

    def base_inputs(self, names: Collection[str]) -> set[str]:
        """Return the recorded inputs from which the inputs and derived inputs of these names are computed."""
        found = set(names)
        for item in reversed(self.derived):
            if item.name in found:
                found.remove(item.name)
                found.update(formula_names(parse_formula(item.formula)))
        return found


class Layout(LayoutKeys, frozen=True, kw_only=True):
    """A whole layout file, checked."""

    path: Path
    """File that it was read from."""
    digest: str
    """SHA-256 of the file, the same for LF and CRLF line ends."""

    @property
    def dbc_path(self) -> Path:
        """Path of the DBC file, the first if there are several; ``Path("no DBC")`` if there is none."""
        return next(iter(self.dbc_paths.values()), Path("no DBC"))

    @property
    def dbc_paths(self) -> dict[str, Path]:
        """Paths of the DBC files, by the keys of ``dbc_files``."""
        return {bus: self.path.parent / file for bus, file in self.dbc_files.items()}

    @property
    def dbc_digest(self) -> str:
        """Digest of the DBC files, see :func:`joint_digest`."""
        return joint_digest([file_digest(path) for path in self.dbc_paths.values()])

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
    see = "see the page 'Layout' of the documentation"
    try:
        content = read_user_file(path, largest_bytes=_MAX_LAYOUT_BYTES)
        document = tomllib.loads(content.decode("utf-8-sig"))  # Windows may write a byte order mark
    except OSError as error:
        advice = "name the layout (TOML) of this vehicle"
        raise LayoutError(f"{path}: cannot read the layout: {error.strerror}; {advice}") from None
    except UnicodeDecodeError:
        raise LayoutError(f"{path}: not a layout: the file is not UTF-8 text; {see}") from None
    except (ValueError, RecursionError) as error:  # not only TOMLDecodeError: numbers and nesting have limits, too
        raise LayoutError(f"{path}: not TOML: {error}; a layout is expected, {see}") from None
    return layout_of(document, path, text_digest(content))


def layout_of(document: dict[str, Any], path: Path, digest: str | None = None) -> Layout:
    """Return the layout that the content of a layout file describes, checked.

    Parameters
    ----------
    document : dict
        Content of a layout file.
    path : Path
        Path of the file, for messages and to find the DBC.
    digest : str, optional
        Digest of the file; that of the document is used if not given.

    Returns
    -------
    Layout
        The checked layout.

    Raises
    ------
    LayoutError
        If a field is missing, unknown or contradictory.
    """
    try:
        keys = msgspec.convert(document, LayoutKeys)
    except msgspec.ValidationError as error:
        steps, what = field_error(error, document, LayoutKeys)
        where = f"{path}: {printable(_toml_place(document, steps))}" if steps else f"{path}"
        raise LayoutError(f"{where}: {what}; see the page 'Layout' of the documentation") from None
    for contradiction in _contradictions(keys):
        raise LayoutError(f"{path}: {contradiction}")
    return Layout(
        **msgspec.structs.asdict(keys), path=path, digest=digest or text_digest(msgspec.json.encode(document))
    )


def _toml_place(document: dict[str, Any], steps: list[str]) -> str:
    """Name a table and key as they stand in the file: ``[[branch]] 'heater', timeout_s``."""
    first, *others = steps
    if isinstance(document[first], dict):
        first = f"[{first}]"
    elif isinstance(document[first], list) and others:
        first = f"[[{first}]] {others.pop(0)}"
    return ", ".join([first, *others])


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a text file, the same for LF and CRLF line ends."""
    return text_digest(path.read_bytes())


def joint_digest(digests: Sequence[str]) -> str:
    """Return the digest of any number of files: the SHA-256 of their digests in a row; of one file, its own digest."""
    return digests[0] if len(digests) == 1 else text_digest("".join(digests).encode())


def _contradictions(layout: LayoutKeys) -> Iterator[str]:
    """Yield errors of keys that are right by themselves, but contradict each other or name what is not there."""
    branches, inputs = layout.branch, [item.name for item in layout.input]
    known = [*inputs, *(item.name for item in layout.derived)]
    outputs = [name for branch in branches for name in (branch.corrected, branch.quality) if name is not None]
    read = {name for branch in branches for name in (branch.signal, branch.power, branch.voltage)}
    read |= {item.signal for item in layout.input}
    for branch in branches:
        yield from (f"branch {branch.name}: {text}" for text in _contradictions_of_branch(branch))
    sources = [branch.source for branch in branches]
    sharing = " and ".join(branch.name for branch in branches if sources.count(branch.source) > 1)
    for names, text in (
        ([*layout.branch_names, *known], "{} is named twice; branches, inputs and derived inputs need different names"),
        (sources, f"branches {sharing}: both read {{}}; each branch needs a signal of its own"),
        ([item.vss for item in branches if item.vss], "vss '{}' stands at two branches; each needs a name of its own"),
        (outputs, "{} is written twice; each 'corrected' and 'quality' needs a signal of its own"),
        ([*{*outputs}, *({*outputs} & read)], "{} is both read and written; give the output a signal of its own"),
        ([bus.name for bus in layout.bus], "[[bus]] name: {} stands there twice; each bus needs one of its own"),
        ([bus.channel for bus in layout.bus], "[[bus]] channel: {} stands there twice; each bus needs one of its own"),
    ):
        yield from (text.format(name) for name in names if names.count(name) > 1)
    if sum(branch.balance for branch in branches) > 1:
        yield "more than one branch has 'balance = true'; at most one can take what the others leave"
    if layout.dbc is not None and layout.bus:
        yield "give either 'dbc', or [[bus]] with a 'dbc' each"
    yield from _contradictions_of_protection(layout)
    if (layout.watch.input is None) != (not layout.watch.valid):
        yield "[watch]: give both 'input' and 'valid', or neither"
    for key, wanted, allowed in (
        ("[contactor] input", [layout.contactor.input] if layout.contactor else [], inputs),
        ("temperature", [layout.temperature] if layout.temperature else [], inputs),
        ("[watch] input", [layout.watch.input] if layout.watch.input else [], inputs),
        ("model_inputs", layout.model_inputs, known),
        ("fleet_inputs", layout.fleet_inputs, known),
    ):
        if unknown := [repr(name) for name in wanted if name not in allowed]:
            yield f"{key}: {', '.join(unknown)} is no [[input]]; declare the signal as one, or leave the name out"


def _contradictions_of_branch(branch: Branch) -> Iterator[str]:
    ways = [way for way in (branch.signal, branch.power, branch.formula) if way is not None]
    message = branch.corrected and split_signal(branch.corrected)[0]
    for is_wrong, text in (
        (
            len(ways) != 1 or (branch.power is None) != (branch.voltage is None),
            "give either 'signal' (a current), 'power' and 'voltage', or 'formula'",
        ),
        (
            branch.formula and (branch.corrected or branch.unit),
            "'formula' gives A and is not written; leave out 'corrected' and 'unit'",
        ),
        (
            not branch.formula and branch.uncertainty,
            "'uncertainty' is that of a 'formula'; a sensor's is what is estimated",
        ),
        (branch.quality and not branch.corrected, "'quality' without 'corrected'"),
        (
            branch.quality and split_signal(branch.quality)[0] != message,
            "'quality' and 'corrected' must be signals of one message",
        ),
    ):
        if is_wrong:
            yield text


def _contradictions_of_protection(layout: LayoutKeys) -> Iterator[str]:
    places: dict[str, str] = {}
    for place, entry in layout.protections:
        for name in entry.messages:
            if name in places:
                how = "is named twice" if places[name] == place else f"stands in {places[name]} too"
                yield f"{place}, messages: {name} {how}; a message has one protection"
            places[name] = place
        for key in ("init", "valid", "invalid"):
            if (frames := getattr(entry, key)).min_ok > frames.window:
                yield f"{place}, {key}: min_ok = {frames.min_ok} of {frames.window} frames; at most all of them can be"
        is_list = isinstance(entry, ProfileP02)
        key = "data_id_list" if is_list else "data_id"
        given = getattr(entry, key)
        if unknown := [name for name in given if name not in entry.messages]:
            yield f"{place}, {key}: {', '.join(unknown)} is not in 'messages'; add it there, or leave its {key} out"
        if is_list and (missing := [name for name in entry.messages if name not in given]):
            yield f"{place}, {key}: {', '.join(missing)} has none; profile P02 needs 16 numbers per message"
