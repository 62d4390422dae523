"""Whether built pages show themselves without any request to another server; what does not is warned of."""

import re
from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.typing import ExtensionMetadata

__all__ = ["requests_of", "setup"]

_LOG = logging.getLogger(__name__)
_ELEMENT = re.compile(r"<(?:script|link|img|iframe|source|video|audio|object|embed|image|use|input)\b[^>]*>", re.I)
_ADDRESS = re.compile(r"""(?:src|srcset|href|data|poster)\s*=\s*["']?((?:https?:)?//[^"'\s>]+)""", re.I)
_STYLE = re.compile(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"'\s)]+)""", re.I)


def requests_of(folder: Path) -> Iterator[tuple[Path, str]]:
    """Find what pages and styles load from elsewhere.

    Parameters
    ----------
    folder : Path
        Of the built pages.

    Yields
    ------
    path : Path
        A page or style.
    address : str
        Of a script, style, font or picture that it loads from another server; links that a reader may follow are none.
    """
    for path in sorted(folder.rglob("*")):
        if path.suffix in {".html", ".css", ".svg"}:
            text = path.read_text(encoding="utf-8")
            elements = " ".join(_ELEMENT.findall(text)) if path.suffix != ".css" else ""
            for address in (*_ADDRESS.findall(elements), *_STYLE.findall(text)):
                yield path.relative_to(folder), address


def _check(app: Sphinx, exception: Exception | None) -> None:
    if exception is None:
        for path, address in requests_of(Path(app.outdir)):
            _LOG.warning("%s loads %s: the pages must show themselves without a network", path, address)


def setup(app: Sphinx) -> ExtensionMetadata:
    """Check the pages when they are built."""
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
