"""What the keys of a layout must not say together, which their types alone cannot express."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from ecu_node.errors import LayoutError
from ecu_node.formula import formula_names, parse_formula
from ecu_node.layout_e2e import ProfileP02
from ecu_node.signal_names import split_signal
from ecu_node.units import AMPERE, WATT, usual_unit

if TYPE_CHECKING:
    from ecu_node.layout import Branch, Input, LayoutKeys

__all__ = ["check_layout"]


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
                refuse(f"{place}: 'Message.Signal' as in the DBC is expected, found \"{name}\"; see docs/layout.md")
            if has_bus and bus not in known:
                refuse(f"{place}: no [[bus]] is named {bus!r}; known are {', '.join(sorted(known)) or 'none'}")


def _repeated(names: Sequence[str]) -> list[str]:
    return sorted({name for name in names if names.count(name) > 1})


def _check_signals(layout: "LayoutKeys", refuse: Callable[[str], NoReturn]) -> None:
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
    if branch.quality is not None and branch.corrected is None:
        refuse(f"branch {branch.name}: 'quality' without 'corrected'")
    if branch.quality and branch.corrected and split_signal(branch.quality)[0] != split_signal(branch.corrected)[0]:
        refuse(f"branch {branch.name}: 'quality' and 'corrected' must be signals of one message")
