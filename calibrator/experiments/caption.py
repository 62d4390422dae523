"""What the columns of the tables mean: a caption names those that are there, and no others."""

from collections.abc import Collection, Sequence

from calibrator.experiments.delay_experiment import LEFT_IN
from calibrator.experiments.methods import CEILING, POSTERIOR

__all__ = ["PAPER", "called", "details_caption", "headline_caption"]

PAPER = "paper"
PUBLISHED = "published"
COLUMNS = {
    PAPER: "the paper's best printed figure",
    PUBLISHED: "the published method (/ its classifier)",
    POSTERIOR.name: "the default (posterior)",
    LEFT_IN.name: "the default with the delays left in",
    CEILING.name: "the default if it is told how the faults were drawn (law known: the most that this evidence gives)",
}
FIGURES = {
    "confidence": "mean confidence",
    "sure": "share of vehicles above 0.95",
    "sure_confidence": "their mean confidence",
    "sure_recovered": "the share of them that is recovered",
    "ece": "expected calibration error (ECE, by tenths)",
    "ece_by_chance": "what it is by chance if the confidence is exact",
    "deployed": "share of the vehicles with faulty sensors that is corrected in some branch (deployed)",
    "harmed": "share of the corrected ones of which some branch gets worse on an unseen drive, however little (harmed)",
    "delay_rmse_ms": "root mean square error of the estimated delays",
    "recovery_rate": "share of vehicles recovered within 10 %",
    "recovery_rate_25": "within 25 %",
    "f2": "f2 of the hardware classification",
    "complexity": "share held to have hardware faults (hardware)",
}


CORRECTS_ALL = (
    "The published method corrects every branch that it regresses, a sound one by what noise leaves there: such a "
    "vehicle counts as harmed although it is recovered."
)


def headline_caption(columns: Collection[str], figures: Collection[str], owners: Sequence[str]) -> str:
    """Caption of a table of recovery rates.

    Parameters
    ----------
    columns : collection of str
        Names of the methods that have a column, and :data:`PAPER` if the paper has one.
    figures : collection of str
        Figures of the owners that have a column, by the names of :mod:`calibrator.experiments.outcome`.
    owners : sequence of str
        The methods that these figures are of.

    Returns
    -------
    str
        Sentences.
    """
    there = {PUBLISHED if name.startswith(f"{PUBLISHED}/") else name for name in columns}
    own = [f"{name} (a method of one's own)" for name in columns if name in there and name not in COLUMNS]
    rates = _enumeration([text for name, text in COLUMNS.items() if name in there] + own)
    more = _enumeration([text for name, text in FIGURES.items() if name in figures])
    text = f"Share of vehicles recovered within 10 %: {rates}."
    return f"{text} Of {_enumeration([called(name) for name in owners])}: {more}." if more else text


def called(method: str) -> str:
    """A method as sentences call it."""
    return "the default" if method == POSTERIOR.name else method


def details_caption(
    figures: Collection[str], explained: Collection[str], methods: Collection[str], *, paper: bool
) -> str:
    """Caption of a table of all figures.

    Parameters
    ----------
    figures : collection of str
        Those that have a column.
    explained : collection of str
        Those that a caption above explains.
    methods : collection of str
        Names of the methods that have a row.
    paper : bool
        Whether the paper's figures are beside.

    Returns
    -------
    str
        Sentences.
    """
    texts = [FIGURES[name] for name in ("recovery_rate", *FIGURES) if name in figures and name not in explained]
    texts = list(dict.fromkeys(texts)) + (["the figures above"] if set(figures) & set(explained) else [])
    corrects_all = "harmed" in figures and any(name.startswith(f"{PUBLISHED}/") for name in methods)
    text = f"Of each method: {_enumeration(texts)}{'; in brackets the paper' if paper else ''}."
    return f"{text} {CORRECTS_ALL}" if corrects_all else text


def _enumeration(texts: Sequence[str]) -> str:
    """Texts with commas, and 'and' before the last."""
    return " and ".join(part for part in (", ".join(texts[:-1]), *texts[-1:]) if part)
