"""Command lines made with argparse: wrong use is one line, and help that cannot be written says so."""

import argparse
import sys
from typing import TYPE_CHECKING, NoReturn

from ecu_node.failures import say_error
from ecu_node.standard_output import write_output

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

__all__ = ["CommandParser"]


class CommandParser(argparse.ArgumentParser):
    """Says wrong use in one line, and that help cannot be written, where argparse would end as if it were."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and where help is."""
        say_error(f"{self.prog}: {message}; see '{self.prog} --help'")
        self.exit(2)

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        if file is not None and file is sys.stdout:
            write_output(message.removesuffix("\n"))
        else:
            super()._print_message(message, file)
