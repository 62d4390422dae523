"""Render texts from the templates of a package with jinja2."""

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

__all__ = ["templates_of"]


def templates_of(package: str, folder: str = "templates", **settings: Any) -> Environment:
    """Return jinja2's environment for the templates of a package; rendering fails if a value is missing.

    Parameters
    ----------
    package, folder : str
        Package, such as ``calibrator.report``, and its folder with the templates.
    **settings
        Settings of jinja2's environment, beside those that all packages share (blocks leave no blank lines behind).
    """
    loader = PackageLoader(package, folder)
    blocks: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    return Environment(loader=loader, undefined=StrictUndefined, **(blocks | settings))  # noqa: S701 (pages set autoescape)
