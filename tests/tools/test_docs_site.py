"""What the documentation site needs beyond Sphinx: equations, formulas of docstrings, pages without requests."""

from pathlib import Path

import pytest
from sphinx.errors import ExtensionError

from docs_site.docstrings import with_formulas
from docs_site.mathml import block_equation
from docs_site.self_contained import requests_of


def test_an_equation_becomes_mathml_with_its_number_as_anchor() -> None:
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


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.html", '<script async src="https://elsewhere.example/x"></script>'),
        ("a.html", "<img alt='x' src=//elsewhere.example/x>"),
        ("a.html", "<style>@import 'https://elsewhere.example/x';</style>"),
        ("a.css", "@font-face { src: url(https://elsewhere.example/x); }"),
    ],
)
def test_what_a_page_loads_from_another_server_is_found(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / "sound.html").write_text('<a href="https://elsewhere.example/">x</a><script src="x.js"></script>')
    (tmp_path / name).write_text(content)
    ((path, address),) = requests_of(tmp_path)
    assert path == Path(name)
    assert address.endswith("//elsewhere.example/x")
