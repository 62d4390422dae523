"""What the doctor finds: one line each, with what to do."""

from dataclasses import dataclass, field
from enum import StrEnum

__all__ = ["Finding", "Severity"]


class Severity(StrEnum):
    """How much a finding matters."""

    ERROR = "error"
    """Results would be wrong, or there would be none."""
    WARNING = "warning"
    """Results may be worse, or a branch be missing."""
    HINT = "hint"
    """Worth knowing; nothing has to be done."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Attributes
    ----------
    severity : Severity
        How much it matters.
    kind : str
        What it is, in a word or two, for programs: ``sign``, ``unit``, ``delay``, ...
    subject : str
        Branch, input or log that it is about.
    text : str
        What, with its figure.
    remedy : str
        What to do: which line of the layout to change, where it is the layout.
    figures : dict
        The figures of the text, with their units in their names.
    """

    severity: Severity
    kind: str
    subject: str
    text: str
    remedy: str
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """The finding as one line, without its severity."""
        return f"{self.subject}: {self.text}; {self.remedy}"
