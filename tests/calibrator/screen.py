"""A Python program at a terminal, and what it shows."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios


class Screen:
    """A program at a terminal of 24 lines; what it shows last."""

    def __init__(self, *arguments: str, columns: int = 80) -> None:
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        environment = {key: value for key, value in os.environ.items() if key not in {"COLUMNS", "LINES"}}
        self._run = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**environment, "TERM": "xterm-256color"},
        )
        os.close(theirs)
        self._text = ""

    def until(self, wanted: str) -> list[str]:
        """Lines of the screen as soon as it has a text."""
        while wanted not in (shown := self._text.rpartition("\x1b[H")[2]):
            self._text += os.read(self._ours, 65536).decode()
        return [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", line) for line in shown.splitlines()]

    def press(self, keys: str) -> None:
        self._text = ""
        os.write(self._ours, keys.encode())

    def ended(self) -> tuple[int, str]:
        try:
            while part := os.read(self._ours, 65536):
                self._text += part.decode()
        except OSError:  # EIO: the other end is closed
            pass
        os.close(self._ours)
        return self._run.wait(), self._text
