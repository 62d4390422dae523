"""The references of the site have every command and every public name."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import typer.main
from typer.core import TyperGroup

from calibrator.cli import app
from docs_site.command_reference import command_help

ROOT = Path(__file__).parents[2]


def commands_of(group: TyperGroup, *path: str) -> set[str]:
    """Names of a group's commands, and of theirs, as the program has them."""
    found = {" ".join(path)}
    for name, command in group.commands.items():
        found |= commands_of(command, *path, name) if isinstance(command, TyperGroup) else {" ".join((*path, name))}
    return found


def test_every_command_of_the_node_is_in_the_reference() -> None:
    wrong = subprocess.run(
        [sys.executable, "-m", "ecu_node", "no-such-command"], capture_output=True, text=True, cwd=ROOT, check=False
    )
    known = re.findall(r"[\w-]+", wrong.stderr.partition("choose from")[2].partition(")")[0])
    assert "run" in known
    assert {name for name, _ in command_help("ecu-node")} == {"ecu-node", *(f"ecu-node {name}" for name in known)}


def test_reference_has_every_command_of_calibrator_with_examples_that_it_accepts() -> None:
    group: Any = typer.main.get_command(app)
    reference = dict(command_help("calibrator"))
    assert reference.keys() == commands_of(group, "calibrator")
    for name, text in reference.items():
        examples = text.replace("\\\n", "").partition("Example:\n")[2].partition("\n\n")[0].splitlines()
        assert examples or isinstance(group.commands.get(name.partition(" ")[2]), TyperGroup), name
        for words in map(shlex.split, examples):
            command, used = group, words[1:]
            while isinstance(command, TyperGroup):
                command, used = command.commands[used[0]], used[1:]
            command.make_context(name, used)


def test_shell_completes_commands() -> None:
    words = {"_CALIBRATOR_COMPLETE": "complete_bash", "COMP_WORDS": "calibrator ki", "COMP_CWORD": "1"}
    shown = subprocess.run(
        [sys.executable, "-m", "calibrator"], capture_output=True, text=True, env=os.environ | words, check=False
    )
    assert shown.stdout.split() == ["kirchhoff"]
