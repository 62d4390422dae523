"""Make Sphinx show docstrings as they are meant.

Indented parts of a module's docstring are formulas, to be shown line by line. In the text under a constant or an
attribute a colon is only a colon, but napoleon would take the words before it for a type.
"""

import re
from itertools import pairwise
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

__all__ = ["setup", "with_formulas"]

OVERVIEW = "docs/reference/api"
"""Document that shows the first sentence of each module, without the references at its end."""
_PAPER, _OTHER_REFERENCE = re.compile(r"\[1\]_"), re.compile(r" \[\d\]_")


def with_formulas(lines: list[str]) -> list[str]:
    """Mark indented paragraphs as literal.

    Parameters
    ----------
    lines : list of str
        Lines of a docstring.

    Returns
    -------
    list of str
        The lines with ``::`` before every indented paragraph that follows one that is not indented, or a list item.
    """
    found, literal = lines[:1], False
    for before, line in pairwise(lines):
        indented = line.startswith("    ")
        if indented and not before and not literal:
            found += ["::", ""]
        literal = indented or (literal and not line)
        found.append(line)
    return found


class _Docstrings:
    """Hooks that run before and after those of napoleon."""

    def __init__(self) -> None:
        self.as_written: list[str] = []

    def before(self, app: Sphinx, what: str, *about: Any) -> None:
        """Show formulas as they stand, and remember the text of constants and attributes."""
        lines: list[str] = about[-1]
        if what == "module" and app.env.docname == OVERVIEW:
            lines[:] = [_OTHER_REFERENCE.sub("", _PAPER.sub("the paper", line)) for line in lines]
        elif what == "module":
            lines[:] = with_formulas(lines)
        self.as_written = list(lines)

    def after(self, _: Sphinx, what: str, *about: Any) -> None:
        """Undo what napoleon did to the text of constants and attributes."""
        if what in {"attribute", "data", "property"}:
            about[-1][:] = self.as_written


def setup(app: Sphinx) -> ExtensionMetadata:
    """Put the hooks before and after napoleon's, whose priority is 500."""
    docstrings = _Docstrings()
    app.connect("autodoc-process-docstring", docstrings.before, priority=400)
    app.connect("autodoc-process-docstring", docstrings.after, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
