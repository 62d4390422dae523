"""Templates and other files of the pages. Whatever stands in a template is escaped."""

from functools import cache
from importlib.resources import files

from jinja2 import Environment, FunctionLoader, StrictUndefined, Template

from calibrator.report.words import amperes, moment, percent, share, with_sd

__all__ = ["asset", "template"]


def asset(name: str) -> str:
    """Text of a file of this package."""
    return (files("calibrator.report") / "assets" / name).read_text("utf-8")


def template(name: str) -> Template:
    """Template of a page."""
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FunctionLoader(asset), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {
        "amperes": amperes,
        "moment": moment,
        "percent": percent,
        "share": share,
        "with_sd": with_sd,
    }
    return environment
