r"""Equations of the documentation as MathML, which browsers draw themselves: no script, no font, no server.

The number of an equation is written as LaTeX's ``\tag``, which code hosts draw as well; ``#eq-M1`` leads to (M1).
"""

import re
from html import escape

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.typing import ExtensionMetadata
from sphinx.writers.html5 import HTML5Translator

__all__ = ["block_equation", "inline_equation", "setup"]

_TAG = re.compile(r"\\tag\{([^}]*)\}")
_CONVERTER = LatexToMathML(fancy_error=False)


def inline_equation(latex: str) -> str:
    """Return the HTML of a formula in a line of text.

    Parameters
    ----------
    latex : str
        The formula.

    Returns
    -------
    str
        An element ``math``.

    Raises
    ------
    ExtensionError
        If it is not LaTeX that the converter knows.
    """
    return _mathml(latex, block=False)


def block_equation(latex: str) -> str:
    r"""Return the HTML of an equation on lines of its own; raises as :func:`inline_equation` does.

    Parameters
    ----------
    latex : str
        The equation, with at most one ``\tag``.

    Returns
    -------
    str
        The equation with its number beside it, which links to itself.
    """
    formula = _mathml(_TAG.sub("", latex), block=True)
    numbers = [escape(number) for number in _TAG.findall(latex)]
    anchors = "".join(f'<a class="eqno" id="eq-{number}" href="#eq-{number}">({number})</a>' for number in numbers)
    return f'<div class="math">{formula}{anchors}</div>\n'


def _mathml(latex: str, *, block: bool) -> str:
    try:
        return _CONVERTER.convert_with_local_state(latex, displaystyle=block)
    except LatexError as error:
        raise ExtensionError(f"cannot draw the equation {latex!r}: {error}") from None


def _visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(inline_equation(node.astext()))
    raise nodes.SkipNode


def _visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    translator.body.append(block_equation(node.astext()))
    raise nodes.SkipNode


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the renderer as ``mathml``."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
