"""Find the branches of the junction among the candidates: score each with reasons, choose, and find the signs."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from calibrator.drive import Array, Channel
from calibrator.kirchhoff.signs import WELL_CORRELATED, Bands, bands_of, likely_multipliers, sag
from calibrator.proposal.candidates import Candidate
from calibrator.terminal.text import figure
from calibrator.words import CURRENT, PLACES, POSITIONS, POWER, VOCABULARY, places_of, word_set, words_of

__all__ = ["ONLY_CHARGING", "TAKEN", "close_sum", "closure", "find_signs", "judge_all"]

TAKEN = 50.0
"""Score from which on a candidate can be a branch: names, comments or sender say where it flows."""
NOT_MEASURED, LIMITS, ELSEWHERE, DCDC_ELSEWHERE, HIGH_VOLTAGE = (
    word_set(VOCABULARY[name]) for name in ("not_measured", "limits", "elsewhere", "dcdc_elsewhere", "high_voltage")
)
MAIN = ("battery", "motor")
NAMED, NAMED_AROUND, HV, MEASURED, BESIDE = 35.0, 40.0, 15.0, 10.0, 20.0
AGAINST, WEAK, STEADY, NEVER = -65.0, -30.0, -40.0, -150.0
"""Points of a candidate. NAMED: name or comment has a word of the place; NAMED_AROUND: these, message or sender have
one; HV: a word for high voltage; MEASURED: a word for current or power, and again if it is a current; BESIDE: a high
voltage in the message of a battery or charger. AGAINST: a word or range excludes it, WEAK: makes it unlikely; STEADY:
its value never changes; NEVER: it cannot be a branch."""
UNITS, LEAST_OF_LOADS = {"current": "A", "power": "W"}, {"current": 3.0, "power": 500.0}
"""Units by quantity, and least range of heaters, converters and chargers in a database; valves have less. [A, W]"""
CELL_V, LOW_V, HIGH_V = 6.0, 40.0, 60.0
"""Bounds of a voltage in the message of a current: below CELL_V it is of a cell, below LOW_V of a network of 12 or
24 V, and from HIGH_V on of a junction. [V]"""
STEADY_SHARE = 0.1
"""A current that varies by less than this share of its peak is steady; how the sum varies then says little. [1]"""
ROUGH, ROUGH_POINTS = 0.5, -50.0
"""A candidate jumps about as no current does if its steps exceed ROUGH times those of white noise of the same spread
(root mean squares); it then gets ROUGH_POINTS. [1]"""
CLEAR = 2.0
"""A sign, or one more branch, is clear if the sum varies this many times more without it. [1]"""
OWN_GAIN, FEWEST_BINS = 1.3, 20
"""A current closes the sum if all gains are within the factor OWN_GAIN of 1; FEWEST_BINS instants are needed. [1]"""
MOST_TOGETHER, MOST_TRIED = 2, 12
"""Most currents without a place that are tried together, and that are tried at all, the best first. [1]"""
MEANS = 50
"""In :func:`find_signs` one row of mean currents is added per so many instants; not more, as the means contain loads
without a sensor."""
ONLY_CHARGING = "carries nothing while the car drives, which a log of charging would show (--log)"
"""Reason why a charger is not taken as a branch where there is a motor, but no log."""


def _score(
    item: Candidate, place: str, everything: Sequence[Candidate], volts: Sequence[Candidate]
) -> tuple[float, str]:
    """Return the score of a current or power as branch at a place, such as ``motor``, and the main reason for it.

    ``everything`` has all candidates, ``volts`` those that are voltages.
    """
    own, near, named = set(item.own), set(item.words), PLACES.get(place, frozenset())
    # "Iheat" of a table is a heater's current; in a database, or beside a motor, heat is a loss.
    allowed = named if item.message is None and places_of(near) == {place} else set()
    no_flow = own & NOT_MEASURED - allowed
    elsewhere = near & (DCDC_ELSEWHERE if place == "dcdc" else ELSEWHERE) - named
    limits = set() if no_flow else (near - own) & LIMITS
    points = [
        (NAMED * bool(own & named) + NAMED_AROUND * bool(near & named), ""),
        (5.0 * bool(named & set(words_of(item.name.rpartition(".")[2]))), ""),
        (-20.0 * (not near & named), "neither name, comment nor sender says where it flows"),
        (HV * bool(near & {"hv", "high", "dc", "traction", "trac"}), ""),
        (MEASURED * bool(own & (CURRENT | POWER)) + MEASURED * (item.quantity == "current"), ""),
        (-0.3 * len(item.name) - 15.0 * ("raw" in own), ""),
        (AGAINST * len(no_flow), f"{_quoted(no_flow)}: a limit, demand, estimate or part of one"),
        (AGAINST * bool(limits), f"its message has {_quoted(limits)}: no measured flow"),
        (AGAINST * bool(elsewhere), f"{_quoted(elsewhere)}: another circuit"),
        _of_range(item, place) if item.channel is None else _of_recording(item, item.channel),
        _of_voltage(item, place, everything, volts) if item.message is not None else (0.0, ""),
    ]
    score, worst = sum(value for value, _ in points), min(points, key=lambda point: point[0])
    best = max(points, key=lambda point: point[0] * bool(point[1]))
    return score, worst[1] if worst[0] < 0.0 and score < TAKEN else best[1]


def _of_range(item: Candidate, place: str) -> tuple[float, str]:
    """Return points and a reason for them by the range in the database."""
    if place not in MAIN and item.reach < LEAST_OF_LOADS[item.quantity]:
        return AGAINST, f"its range ends at {item.reach:g} {UNITS[item.quantity]}: no load of a junction"
    if place in MAIN and item.low >= 0.0:
        ranged = item.signal is not None and bool(item.signal.minimum or item.signal.maximum)
        return WEAK if ranged else 0.5 * WEAK, "in the database it cannot be negative"
    return 0.0, ""


def _of_recording(item: Candidate, channel: Channel) -> tuple[float, str]:
    """Return points and a reason for them by the candidate's values in a recording."""
    value, unit = item.good, UNITS[item.quantity]
    if len(value) < 0.5 * len(channel.value):
        unusable = f"{100.0 * (1.0 - len(value) / len(channel.value)):.0f} % of its values are not usable"
        return NEVER, item.comment if item.signal is None and item.comment else unusable
    if np.ptp(value) == 0.0:
        empty = 0.0 if item.signal is None else item.factor * float(item.signal.offset)
        return NEVER if value[0] in {0.0, empty} else STEADY, f"reads {value[0]:g} {unit} throughout the recording"
    if np.sqrt(np.mean(np.diff(value) ** 2) / 2.0) > ROUGH * value.std():
        return ROUGH_POINTS, "jumps about as no current does"
    return 5.0, f"{figure(value.min())} to {figure(value.max())} {unit}"


def _of_voltage(
    item: Candidate, place: str, everything: Sequence[Candidate], volts: Sequence[Candidate]
) -> tuple[float, str]:
    """Return points and a reason for them by the greatest voltage in the candidate's message."""
    beside = [v for v in volts if v.message is item.message and not {"cell", "brick", "ref"} & set(v.own)]
    rated = [(float(np.median(v.good)) if len(v.good) else v.reach, v.name) for v in beside]
    greatest_v, name = max(rated, default=(np.nan, ""))
    if CELL_V < greatest_v < LOW_V and place != "dcdc":
        return NEVER, f"{name.rpartition('.')[2]} beside it is at most {greatest_v:.3g} V: not at the junction"
    if place not in {"battery", "charger"} or greatest_v >= HIGH_V:
        return BESIDE * (place in {"battery", "charger"}), ""
    if place == "charger":
        setting = item.channel is None and item.quantity == "current"
        return 1.5 * WEAK * setting, "no voltage is beside it: perhaps a setting"
    around = _names(item)
    if any(
        HIGH_VOLTAGE & set(other.words) for other in everything if other.name == item.name or around & _names(other)
    ):
        return 0.0, ""
    return AGAINST, "nothing says that it is of a high-voltage battery"


def _names(item: Candidate) -> set[str]:
    """Return the names of the candidate's message and of its senders, without placeholders such as ``XXX``."""
    return {item.message.name, *item.message.senders} - {"XXX", "Vector__XXX"} if item.message is not None else set()


def _quoted(words: set[str]) -> str:
    return ", ".join(f"'{word}'" for word in sorted(words))


def judge_all(found: Sequence[Candidate], everything: Sequence[Candidate]) -> list[Candidate]:
    """Return all currents and powers with scores and reasons, and names for those that are branches.

    Parameters
    ----------
    found : sequence of Candidate
        All candidates of a database or table; with a log, only signals that the log holds.
    everything : sequence of Candidate
        All candidates, also those that the log does not hold: their words may tell what a message or sender is about.

    Returns
    -------
    list of Candidate
        The branches first, in the order of a layout; then the rest, the best first. Their signs are not set yet.
    """
    volts = [item for item in found if item.quantity == "voltage"]
    judged = []
    for item in (item for item in found if item.quantity in {"current", "power"}):
        places = [*filter(places_of(item.words).__contains__, PLACES)] or [""]
        rated = {place: _score(item, place, everything, volts) for place in places}
        place = max(rated, key=lambda name: rated[name][0])
        judged.append(replace(item, place=place, score=rated[place][0], why=rated[place][1]))
    judged.sort(key=lambda item: -item.score)
    taken = _named_branches(judged)
    for k, item in enumerate(judged):
        if k in taken:
            judged[k] = replace(item, branch=taken[k])
        elif item.score >= TAKEN:
            rival = next(other.name for j, other in enumerate(judged) if j in taken and other.place == item.place)
            judged[k] = replace(item, why=f"{rival.rpartition('.')[2]} fits better")
    order = list(PLACES)
    return sorted(judged, key=lambda item: order.index(item.place) if item.branch else len(order))


def _named_branches(judged: Sequence[Candidate]) -> dict[int, str]:
    """Return branch names by position in ``judged``, as ``{3: "motor_rear"}``: the best one per place and position."""
    taken: dict[int, str] = {}
    for place in PLACES:
        good = [k for k, item in enumerate(judged) if item.place == place and item.score >= TAKEN]
        positions = {k: "" if place == "battery" else _position(judged[k], judged) for k in good}
        if len({position for position in positions.values() if position}) > 1:
            good = [k for k in good if positions[k]]  # without a position it is of all together: no branch
        best = {positions[k]: k for k in reversed(good)}
        for position, k in best.items():
            is_named = position and (len(best) > 1 or not position.isdigit())
            taken[k] = f"{place}_{position}" if is_named else place
    return taken


def _position(item: Candidate, judged: Sequence[Candidate]) -> str:
    """Return where a motor or the like is, ``rear`` or a number, if name, comment or message say so; else empty."""
    for words in (item.own, item.words):
        if found := [position for position in POSITIONS if position in words]:
            return found[0]
    if item.place != "motor":
        return ""
    letters = [word for word in item.own if not word.isdigit()]
    alike = [v for v in judged if [w for w in v.own if not w.isdigit()] == letters and v.score >= TAKEN]
    return next((word for word in item.own if word.isdigit()), "") if len(alike) > 1 else ""


def close_sum(judged: Sequence[Candidate], voltage: Candidate | None) -> list[Candidate]:
    """Turn currents whose place is unknown into branches, one or two at a time, if the sum varies far less with them.

    The battery's current is fitted by the other branches, each with a gain. With the added currents all gains must be
    within a factor of 1.3 of 1, which excludes copies of a branch, and less than half of the residual must be left.
    Nothing changes if there is no battery, or no second branch.

    Parameters
    ----------
    judged : sequence of Candidate
        All candidates, the branches first, and of these the battery first.
    voltage : Candidate or None
        Voltage by which powers are divided.

    Returns
    -------
    list of Candidate
        All candidates, the branches first.
    """
    result = list(judged)
    free = [
        k
        for k, item in enumerate(result)
        if not item.branch and not item.place and item.score > 0.5 * AGAINST and item.quantity == "current"
    ]
    for group in (group for size in range(1, MOST_TOGETHER + 1) for group in combinations(free[:MOST_TRIED], size)):
        taken, added = [other for other in result if other.branch], [result[k] for k in group]
        if any(item.branch for item in added) or len(taken) < 2 or taken[0].place != "battery":
            continue
        channels = _channels((*taken, *added), voltage)
        if not channels or len(current := bands_of([channels]).current_a) < FEWEST_BINS:
            continue
        battery, others = current[:, 0], current[:, 1:]
        gain = np.abs(np.linalg.lstsq(others, battery)[0])
        left = [_rms(battery - part @ np.linalg.lstsq(part, battery)[0]) for part in (others[:, : -len(group)], others)]
        if CLEAR * left[1] < left[0] and np.all((gain > 1.0 / OWN_GAIN) & (gain < OWN_GAIN)):
            for number, k in enumerate(group, start=len(taken)):
                is_first = all(other.branch != "auxiliary" for other in result)
                name = "auxiliary" if is_first else f"auxiliary_{number}"
                why = f"varies by {figure(left[1], 2)} A with it, and by {figure(left[0], 2)} A without"
                why = f"closes the sum{' with others' if len(group) > 1 else ''}: it {why}"
                result[k] = replace(result[k], place="auxiliary", branch=name, score=TAKEN, why=why)
    return sorted(result, key=lambda item: not item.branch)


def _with_usual_sign(item: Candidate) -> Candidate:
    """Return the candidate with the sign that its comment states, else as if discharge or consumption were positive."""
    gives, words = item.place in {"battery", "charger"}, set(words_of(item.comment))
    out, into = ("discharge", "charge") if gives else ("recuperation", "consumption")
    if "positive" in words and (out in words) != (into in words):
        said = out if out in words else into
        return replace(item, sign=1 if said == out else -1, sign_reason=f"its comment says that {said} is positive")
    what = {"battery": "discharge", "charger": "feeding the junction"}.get(item.place, "consumption")
    sign = 1 if gives else -1
    return replace(item, sign=sign, sign_reason=f"if {what} counts as positive; else {-sign}")


def _channels(branches: Sequence[Candidate], voltage: Candidate | None) -> list[Channel]:
    """Return the currents of the candidates, powers divided by the voltage [A]; empty if the recording lacks one."""
    channels = []
    for item in branches:
        if (channel := item.channel) is None:
            return []
        if item.quantity != "current":
            volts = voltage.at(channel.time_s) if voltage is not None else np.full(len(channel.time_s), np.nan)
            good = channel.good & (np.abs(volts) > 1.0)
            value = np.divide(channel.value, volts, out=np.zeros_like(volts), where=good)
            channel = replace(channel, value=value, good=good)
        channels.append(channel)
    return channels if all(channel.good.any() for channel in channels) else []


def find_signs(chosen: Sequence[Candidate], voltage: Candidate | None) -> list[Candidate]:
    """Return the branches with signs for which the sum varies least and the battery's voltage falls under load.

    Parameters
    ----------
    chosen : sequence of Candidate
        The branches.
    voltage : Candidate or None
        Voltage of the battery.

    Returns
    -------
    list of Candidate
        The branches with their signs and the reasons for these; usual signs where the recording does not tell.
    """
    chosen = [_with_usual_sign(item) for item in chosen]
    known, places = _channels(chosen, voltage), [item.place for item in chosen]
    if "battery" not in places or not known:
        return chosen
    current, battery = bands_of([known]).current_a, places.index("battery")
    # Some rows of means are added: they tell the signs where the currents are steady.
    mean = [float(channel.value[channel.good].mean()) for channel in known]
    current = np.concatenate([current, np.tile(mean, (len(current) // MEANS + 1, 1))])
    usual = np.array([item.sign for item in chosen], np.float64)
    falls = sag([(known[battery], voltage.channel)]) if voltage is not None and voltage.channel is not None else 0.0
    by_voltage = abs(falls) >= WELL_CORRELATED
    sure = battery if by_voltage or "charger" not in places else places.index("charger")  # only feeds
    usual[sure] = -np.sign(falls) if by_voltage else usual[sure]
    part = Bands(current * usual, np.zeros(len(current), np.intp))

    def price(turned: Array) -> float:
        return np.inf if turned[sure] < 0.0 else 1e-6 * float(np.sum(turned < 0.0))

    best, signed = usual * likely_multipliers(part, price, factors=(1.0,), sure=False), []
    for k, item in enumerate(chosen):
        other = best * np.where(np.arange(len(chosen)) == k, -1.0, 1.0)
        with_it, without = _rms(current @ best), _rms(current @ other)
        sums = f"with it the sum of all varies by {figure(with_it, 2)} A, else by {figure(without, 2)} A"
        sign, reason = int(best[k]), sums
        if k == sure:
            reason = "with it the voltage falls when the current rises" if by_voltage else item.sign_reason
        elif without < CLEAR * with_it or without == 0.0:
            sign, reason = item.sign, f"{item.sign_reason}; too little current for the sum to tell"
        signed.append(replace(item, sign=sign, sign_reason=reason))
    return signed


def closure(chosen: Sequence[Candidate], voltage: Candidate | None) -> float:
    """Return how much the sum varies (RMS), over the variation of the current that varies most; NaN if not recorded.

    Of a current that hardly varies, :data:`STEADY_SHARE` of its peak counts as its variation. [1]
    """
    if not (known := _channels(chosen, voltage)):
        return float("nan")
    current = bands_of([known]).current_a * np.array([item.sign for item in chosen])
    steady = [STEADY_SHARE * float(np.abs(channel.value[channel.good]).max(initial=0.0)) for channel in known]
    greatest = max(float(current.std(axis=0).max()), *steady) if len(current) else 0.0
    return _rms(current.sum(axis=1)) / greatest if greatest > 0.0 else float("nan")


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2)))
