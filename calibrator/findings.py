"""A finding: one thing that is wrong with a recording, a layout or a vehicle, or worth knowing of it."""

from collections.abc import Iterable, Iterator
from enum import StrEnum
from functools import partial

import msgspec

__all__ = ["Finding", "Findings", "Severity", "error", "hint", "warning", "worst_first"]


class Severity(StrEnum):
    """How much a finding matters."""

    ERROR = "error"
    """Results would be wrong, or there would be none."""
    WARNING = "warning"
    """Results may be worse, or a branch be missing."""
    HINT = "hint"
    """Worth knowing; nothing has to be done."""


class Finding(msgspec.Struct, frozen=True):
    """One thing that is wrong, or worth knowing.

    Attributes
    ----------
    severity : Severity
        How much it matters.
    code : str
        Kind of finding in a word or two, for programs: ``sign``, ``unit``, ``delay``, ...
    subject : str
        Branch, input or log that it is about; ``sum`` for the sum of the currents.
    text : str
        What is wrong, with the figure that shows it.
    advice : str
        What to do, for example which line of the layout to change; empty if the text says it.
    number : float or None
        Figure for programs: a current [A], time [s], share or factor [1], count, or value in the unit of an input.
    """

    severity: Severity
    code: str
    subject: str
    text: str
    advice: str = ""
    number: float | None = None

    @property
    def line(self) -> str:
        """The finding as one line; a terminal folds long ones."""
        return f"{self.severity:<9}{self.subject}: {self.text}" + (f"; {self.advice}" if self.advice else "")


Findings = Iterator[Finding]
error, warning, hint = (partial(Finding, severity) for severity in Severity)
"""Each makes a :class:`Finding` of its severity from code, subject, text, advice and number."""


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings sorted: errors, warnings, hints; those of one severity stay in the given order."""
    order = list(Severity)
    return sorted(findings, key=lambda each: order.index(each.severity))
