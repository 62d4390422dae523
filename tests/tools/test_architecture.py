"""The house stands: the node is light, no room goes round in circles, and the picture shows the rooms as they are."""

from pathlib import Path

import pytest

import architecture
from architecture import drawing, problems_of_ground, problems_of_node, problems_of_rooms, room_imports, rows_of


def test_the_node_imports_nothing_heavy_and_nothing_of_the_calibrator() -> None:
    assert problems_of_node() == []


def test_rooms_import_only_rooms_before_them() -> None:
    assert problems_of_ground() == []
    assert problems_of_rooms(room_imports()) == []


def test_the_picture_is_that_of_the_imports() -> None:
    assert architecture.PICTURE.read_text(encoding="utf-8") == drawing(room_imports())


@pytest.mark.parametrize(
    ("package", "file", "text", "problem"),
    [
        ("ecu_node", "node.py", "def run():\n    import numpy.linalg\n", "ecu_node/node.py imports numpy.linalg"),
        ("ecu_node", "node.py", "from calibrator.drive import Drive\n", "ecu_node/node.py imports calibrator.drive"),
        ("ecu_node", "node.py", "import rich\n", "ecu_node/node.py imports rich"),
        ("calibrator", "drive.py", "from calibrator.drives.store import read\n", "imports from the room drives"),
        ("calibrator", "drives/store.py", "from calibrator.posterior import fleet\n", "rooms import each other"),
    ],
)
def test_what_breaks_a_rule_is_named(
    package: str, file: str, text: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("ecu_node", "calibrator/drives", "calibrator/posterior"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / "calibrator/posterior/fleet.py").write_text("from calibrator.drives.store import read\n")
    (tmp_path / "calibrator/drives/store.py").write_text("")
    (tmp_path / package / file).write_text(text)
    monkeypatch.setattr(architecture, "ROOT", tmp_path)
    found = [*problems_of_node(), *problems_of_ground(), *problems_of_rooms(room_imports())]
    assert len(found) == 1
    assert problem in found[0]


def test_every_room_stands_below_what_it_imports() -> None:
    rows = rows_of({"a": frozenset(), "b": frozenset({"a"}), "c": frozenset({"a", "b"}), "d": frozenset()})
    assert rows == [["a"], ["b"], ["c", "d"]]
