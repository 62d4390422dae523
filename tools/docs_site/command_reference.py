"""Command line reference: what the programs themselves print for ``--help``, one section per command.

In a document ``{command-reference} ecu-node`` stands for the sections of all commands of ecu-node.
"""

import io
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout, suppress
from unittest.mock import patch

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from calibrator import cli as calibrator_cli
from ecu_node import cli as node_cli

__all__ = ["PROGRAMS", "command_help", "setup"]

PROGRAMS: dict[str, Callable[[], int]] = {
    "calibrator": calibrator_cli.run_calibrator,
    "ecu-node": node_cli.run_ecu_node,
}
"""Function that runs each program with the arguments of the process."""
_WIDTH = "80"
"""Width of the terminal for which the help is written. [characters]"""
_COMMANDS = re.compile(r"(?mi)^commands\b[^\n]*:\n((?:[ ]+.*\n)+)")
_NAME = re.compile(r"(?m)^ {2,4}([a-z][a-z-]*)")


def command_help(program: str, *path: str) -> Iterator[tuple[str, str]]:
    """Yield what a program prints for ``--help``, then what each of its commands prints.

    Parameters
    ----------
    program : str
        One of :data:`PROGRAMS`.
    *path : str
        Command of the program, and command of that command; none: the program itself.

    Yields
    ------
    name, text : str
        Such as ``calibrator repository key`` and its help; a command comes before its own commands.
    """
    text = _printed(program, [*path, "--help"])
    yield " ".join((program, *path)), text
    for listed in _COMMANDS.findall(text):
        for name in _NAME.findall(listed):
            yield from command_help(program, *path, name)


def _printed(program: str, arguments: list[str]) -> str:
    printed, terminal = io.StringIO(), patch.dict(os.environ, COLUMNS=_WIDTH)
    with patch.object(sys, "argv", [program, *arguments]), terminal, redirect_stdout(printed), suppress(SystemExit):
        PROGRAMS[program]()
    return printed.getvalue()


class _CommandReference(SphinxDirective):
    """Directive for the section of a program, with those of its commands."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        program, *commands = [self._section(name, text) for name, text in command_help(self.arguments[0])]
        program += commands
        return [program]

    def _section(self, name: str, text: str) -> nodes.section:
        section = nodes.section(names=[nodes.fully_normalize_name(name)])
        section += nodes.title(name, name)
        section += nodes.literal_block(text, text, language="text")
        self.state.document.note_implicit_target(section)
        return section


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive ``command-reference``."""
    app.add_directive("command-reference", _CommandReference)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
