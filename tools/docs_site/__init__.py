"""What the documentation site needs beyond Sphinx itself."""

from pathlib import Path


class GalleryOrder:
    """Order in which a newcomer reads the examples; sphinx-gallery makes one for each folder of examples."""

    FIRST = ("one_car.py", "from_a_spreadsheet.py", "two_chargers.py", "twelve_vehicles.py", "replay_and_node.py")

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def __call__(self, name: str) -> tuple[bool, int, str]:
        """Sort key of an example; those that are not named come last."""
        known = name in self.FIRST
        return not known, self.FIRST.index(name) if known else 0, name
