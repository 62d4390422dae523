"""What the documentation site needs beyond Sphinx: equations, and formulas of docstrings."""

import pytest
from sphinx.errors import ExtensionError

from docs_site.docstrings import with_formulas
from docs_site.mathml import block_equation


def test_equation_becomes_mathml_with_its_number_as_anchor() -> None:
    html = block_equation(r"i_m = (1 + d)\, i + o \tag{M2}")
    assert html.startswith('<div class="math"><math display="block">')
    assert '<a class="eqno" id="eq-M2" href="#eq-M2">(M2)</a>' in html
    assert "<a" not in block_equation("a = b")
    with pytest.raises(ExtensionError, match=r"cannot draw the equation .*nosuchcommand"):
        block_equation(r"a = \nosuchcommand{b}")


def test_indented_paragraphs_of_a_docstring_are_shown_line_by_line() -> None:
    text = ["With this", "", "    a = b", "", "    c = d", "", "and that."]
    assert with_formulas(text) == ["With this", "", "::", "", "    a = b", "", "    c = d", "", "and that."]
    assert with_formulas(["1. item", "   goes on"]) == ["1. item", "   goes on"]
