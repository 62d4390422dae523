from pathlib import Path

import pytest

from calibrator.drives.fleet_id import read_fleet_ids, require_same_fleet, write_fleet_ids
from calibrator.errors import FleetError


def test_ids_are_read_as_they_were_written(tmp_path: Path) -> None:
    write_fleet_ids(tmp_path, {"b", "a"})
    assert read_fleet_ids(tmp_path) == {"a", "b"}


def test_recorded_drives_have_none(tmp_path: Path) -> None:
    assert read_fleet_ids(tmp_path) == frozenset()
    assert read_fleet_ids(tmp_path / "none") == frozenset()


def test_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "fleet.id").write_bytes(b"\xff\xfe")
    with pytest.raises(FleetError, match=r"fleet\.id: cannot be read; remove it"):
        read_fleet_ids(tmp_path)


@pytest.mark.parametrize("found", [set(), {"a"}])
def test_the_same_or_an_unknown_fleet_passes(found: set[str]) -> None:
    require_same_fleet(found, "a", drives=Path("result"), truth=Path("truth.json"))


@pytest.mark.parametrize("found", [{"b"}, {"a", "b"}])
def test_another_fleet_or_a_mixture_is_refused(found: set[str]) -> None:
    with pytest.raises(FleetError, match=r"truth\.json: the truth of fleet a, but result is of fleet (a and )?b;"):
        require_same_fleet(found, "a", drives=Path("result"), truth=Path("truth.json"))
