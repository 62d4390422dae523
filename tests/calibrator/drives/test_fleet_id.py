from pathlib import Path

import pytest

from calibrator.drives.fleet_id import read_fleet_ids, require_same_fleet, write_fleet_ids
from calibrator.errors import FleetError


def test_ids_are_read_as_they_were_written_and_recorded_drives_have_none(tmp_path: Path) -> None:
    assert read_fleet_ids(tmp_path) == read_fleet_ids(tmp_path / "none") == frozenset()
    write_fleet_ids(tmp_path, {"b", "a"})
    assert read_fleet_ids(tmp_path) == {"a", "b"}
    (tmp_path / "fleet.id").write_bytes(b"\xff\xfe")
    with pytest.raises(FleetError, match=r"fleet\.id: cannot be read; remove it"):
        read_fleet_ids(tmp_path)


def test_truth_of_another_fleet_is_refused() -> None:
    for found in (set[str](), {"a"}):
        require_same_fleet(found, "a", drives=Path("result"), truth=Path("truth.json"))
    for found in ({"b"}, {"a", "b"}):
        with pytest.raises(FleetError, match=r"truth\.json: the truth of fleet a, but result is of fleet (a and )?b;"):
            require_same_fleet(found, "a", drives=Path("result"), truth=Path("truth.json"))
