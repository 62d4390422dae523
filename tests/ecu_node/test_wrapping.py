"""Long lines: broken at words on a terminal, whole elsewhere."""

import io
import os
import pty

import pytest

from ecu_node.program import fitted, wrapped

TEXT = (
    "notice: a text that is longer than the terminal is wide\n  /a/very/long/path/that/stays/whole: and more words\nend"
)


def test_lines_are_broken_at_words_and_what_follows_is_indented() -> None:
    assert wrapped(TEXT, 30).split("\n") == [
        "notice: a text that is longer",
        "    than the terminal is wide",
        "  /a/very/long/path/that/stays/whole:",
        "      and more words",
        "end",
    ]


def test_no_word_is_lost_and_columns_of_a_table_stay() -> None:
    assert wrapped(TEXT, 30).split() == TEXT.split()
    assert wrapped("a   b   c", 80) == "a   b   c"


def test_a_pipe_gets_every_line_whole() -> None:
    assert fitted(TEXT, io.StringIO()) == TEXT
    assert fitted(TEXT, None) == TEXT


@pytest.mark.parametrize(("columns", "lines"), [("30", 5), ("200", 3), ("0", 3), ("many", 3)])
def test_a_terminal_gets_lines_as_long_as_it_is_wide(columns: str, lines: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w") as terminal:
        assert len(fitted(TEXT, terminal).split("\n")) == lines
    os.close(ours)
