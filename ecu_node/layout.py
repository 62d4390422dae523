"""Layout: a TOML file that says what the signals of one DBC mean.

It names the branches of the junction with their sign, the inputs, where corrected values go, timeouts and limits.
All later steps use the names given here; the DBC's own names appear nowhere else.
"""

import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import msgspec

from ecu_node.errors import LayoutError
from ecu_node.field_errors import field_error, toml_place
from ecu_node.formula import formula_names, parse_formula
from ecu_node.user_files import UnsuitableFileError, read_user_file, text_digest

__all__ = [
    "MAX_LAYOUT_BYTES",
    "Branch",
    "Contactor",
    "CounterCrc8",
    "Derived",
    "EndToEnd",
    "Input",
    "Layout",
    "Limits",
    "Name",
    "ProfileP01",
    "ProfileP02",
    "ProfileP05",
    "SignalName",
    "StatusMessage",
    "UnmeasuredLoad",
    "Watch",
    "file_digest",
    "read_layout",
    "split_signal",
]

Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""A name without blanks."""
SignalName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\.[A-Za-z_][A-Za-z0-9_]*$")]
"""``Message.Signal``, as both are called in the DBC."""

MAX_LAYOUT_BYTES = 1_000_000
"""A layout has some kilobytes; a larger file is not one."""

_Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]


class Branch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One HV current at the junction: a current signal, or a power signal divided by a voltage signal."""

    name: Name
    sign: Literal[1, -1]
    """+1 if the signal is positive into the junction, -1 if positive out of it."""
    signal: SignalName | None = None
    power: SignalName | None = None
    voltage: SignalName | None = None
    timeout_s: _Positive = 0.5
    """Without a frame for this long the branch is stale. [s]"""
    balance: bool = False
    """In ground truth made from recordings, this branch is minus the sum of the others, (19) of the paper."""
    corrected: SignalName | None = None
    quality: SignalName | None = None
    no_value: list[int] = []
    """Raw codes of the signal that are no values, beyond those that the DBC names."""

    @property
    def source(self) -> SignalName:
        """The signal whose frames carry this branch."""
        source = self.signal or self.power
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


_DataId = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]
_Offset = Annotated[int, msgspec.Meta(ge=0, le=60)]


class _Protected(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    messages: list[Name]
    max_delta_counter: Annotated[int, msgspec.Meta(ge=1, le=255)] = 3
    """Largest step of the counter between two frames that is used: one more than the frames that may be lost."""


class ProfileP01(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P01"):
    """AUTOSAR E2E profile 1: CRC-8 and a counter of 4 bits."""

    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    data_id_mode: Literal["both", "alternating", "low", "nibble"] = "both"
    """Which bytes of the data identifier the CRC covers: profile 1A, 1B, the low one only, 1C."""
    offset: _Offset = 0
    """First byte of the header."""


class ProfileP02(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P02"):
    """AUTOSAR E2E profile 2: CRC-8 and a counter of 4 bits that selects one of 16 data identifiers."""

    data_id_list: dict[
        str, Annotated[list[Annotated[int, msgspec.Meta(ge=0, le=255)]], msgspec.Meta(min_length=16, max_length=16)]
    ]
    """Data identifiers per message."""


class ProfileP05(_Protected, frozen=True, kw_only=True, tag_field="profile", tag="P05"):
    """AUTOSAR E2E profile 5: CRC-16 and a counter of 8 bits."""

    data_id: dict[str, _DataId] = {}
    """Data identifier per message; the message's own identifier where not given."""
    offset: _Offset = 0
    """First byte of the header."""


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


EndToEnd = ProfileP01 | ProfileP02 | ProfileP05 | CounterCrc8
"""How some messages are protected."""


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


class Layout(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole layout file, checked."""

    schema: Literal[1]
    name: Name
    dbc: str
    """Path of the DBC, relative to the layout file."""
    full_scale_a: _Positive
    branch: Annotated[list[Branch], msgspec.Meta(min_length=2, max_length=16)]
    period_s: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = 0.1
    max_age_s: _Positive = 1.0
    """An input without a frame for this long is stale. [s]"""
    input: list[Input] = []
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
    e2e: list[EndToEnd] = []
    on_bad_frame: Literal["hold", "invalid"] = "hold"
    """What the node makes of a frame that fails its check: nothing, or one that is seen to be invalid."""
    watch: Watch = Watch()
    path: Path = Path()
    """Where the layout was read from; set by :func:`read_layout`."""
    digest: str = ""
    """SHA-256 of the file; set by :func:`read_layout`."""

    @property
    def branch_names(self) -> tuple[str, ...]:
        """Names of the branches in the order of the file."""
        return tuple(branch.name for branch in self.branch)

    @property
    def dbc_path(self) -> Path:
        """Path of the DBC file."""
        return self.path.parent / self.dbc

    @property
    def offset_limit_a(self) -> float:
        """Largest magnitude of an offset that the node accepts. [A]"""
        return self.limits.offset_a if self.limits.offset_a is not None else 0.4 * self.full_scale_a

    @property
    def watch_margin_a(self) -> float:
        """By how much the corrected sum must be worse than the measured one. [A]"""
        return self.watch.margin_a if self.watch.margin_a is not None else 0.0025 * self.full_scale_a

    def protection(self, message: str) -> EndToEnd | None:
        """How a message is protected; None if it is not."""
        return next((entry for entry in self.e2e if message in entry.messages), None)

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
        raise LayoutError(f"{path}: cannot read the layout: {why}") from None
    except UnicodeDecodeError:
        raise LayoutError(f"{path}: not a layout: the file is not UTF-8 text") from None
    except (ValueError, RecursionError) as error:  # not only TOMLDecodeError: numbers and nesting have limits, too
        raise LayoutError(f"{path}: not TOML: {error}") from None
    if isinstance(document.get("e2e"), dict):  # one profile: a table will do
        document["e2e"] = [document["e2e"]]
    known = [kind.__struct_config__.tag for kind in (ProfileP01, ProfileP02, ProfileP05, CounterCrc8)]
    for entry in document["e2e"] if isinstance(document.get("e2e"), list) else []:
        if isinstance(entry, dict) and entry.get("profile") not in known:
            raise LayoutError(
                f"{path}: [e2e] profile: expected {', '.join(map(str, known))}, found {entry.get('profile')!r}"
            )
    try:
        layout = msgspec.convert(document, Layout)
    except msgspec.ValidationError as error:
        raise LayoutError(f"{path}: {field_error(error, document, Layout, toml_place)}; see docs/layout.md") from None
    _check(layout, path)
    return msgspec.structs.replace(layout, path=path, digest=text_digest(content))


def file_digest(path: Path) -> str:
    """SHA-256 of a text file, the same for LF and CRLF line ends."""
    return text_digest(path.read_bytes())


def split_signal(name: SignalName) -> tuple[str, str]:
    """Split ``Message.Signal`` into its two names."""
    message, _, signal = name.partition(".")
    return message, signal


def _check(layout: Layout, path: Path) -> None:
    """Refuse what types alone cannot express."""

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
    _check_signals(layout, refuse)
    _check_inputs(layout, refuse)
    _check_protection(layout, refuse)


def _check_protection(layout: Layout, refuse: Callable[[str], NoReturn]) -> None:
    for name in _repeated([name for entry in layout.e2e for name in entry.messages]):
        refuse(f"[e2e] messages: {name} is named twice; a message has one protection")
    for entry in layout.e2e:
        given = entry.data_id_list if isinstance(entry, ProfileP02) else entry.data_id
        unknown = [name for name in given if name not in entry.messages]
        if unknown:
            refuse(f"[e2e] data_id: {', '.join(unknown)} is not in 'messages'; add it there, or leave its data_id out")
        if isinstance(entry, ProfileP02):
            missing = [name for name in entry.messages if name not in entry.data_id_list]
            if missing:
                refuse(f"[e2e] data_id_list: {', '.join(missing)} has none; profile P02 needs 16 numbers per message")


def _repeated(names: Sequence[str]) -> list[str]:
    return sorted({name for name in names if names.count(name) > 1})


def _check_signals(layout: Layout, refuse: Callable[[str], NoReturn]) -> None:
    """Refuse one signal for two branches, for two outputs, or for both reading and writing."""
    for name in _repeated([branch.source for branch in layout.branch]):
        sharing = " and ".join(branch.name for branch in layout.branch if branch.source == name)
        refuse(f"branches {sharing}: both read {name}; each branch needs a signal of its own")
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


def _check_inputs(layout: Layout, refuse: Callable[[str], NoReturn]) -> None:
    known = {item.name for item in layout.input}
    for item in layout.derived:
        try:
            names = formula_names(parse_formula(item.formula))
        except LayoutError as error:
            refuse(f"derived input {item.name}: {error}")
        unknown = [name for name in names if name not in known]
        if unknown:
            refuse(f"derived input {item.name}: {', '.join(unknown)} is no input or derived input declared above it")
        known.add(item.name)
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


def _check_branch(branch: Branch, refuse: Callable[[str], NoReturn]) -> None:
    if (branch.signal is None) == (branch.power is None) or (branch.power is None) != (branch.voltage is None):
        refuse(f"branch {branch.name}: give either 'signal' (a current), or 'power' and 'voltage'")
    if branch.quality is not None and branch.corrected is None:
        refuse(f"branch {branch.name}: 'quality' without 'corrected'")
    if branch.quality and branch.corrected and split_signal(branch.quality)[0] != split_signal(branch.corrected)[0]:
        refuse(f"branch {branch.name}: 'quality' and 'corrected' must be signals of one message")
