"""What can be calibrated: settings that do not contradict each other, and a place that holds what they need."""

from pathlib import Path

from calibrator.calibration_settings import CalibrationSettings, require_learning
from calibrator.errors import ContradictionError, FleetError
from calibrator.files.storage import Storage
from calibrator.options import Method
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import LOGS_FOLDER, STORE_FOLDER, FleetSource, find_fleet
from calibrator.terminal.text import few, few_reasons

__all__ = ["find_drives", "require_consistent", "require_drives_unneeded", "require_folder", "require_summaries_alone"]


def require_consistent(settings: CalibrationSettings, since: Path | None) -> None:
    """Refuse settings that contradict each other."""
    both = settings.hold_out & settings.trusted
    if both:
        raise ContradictionError(
            f"vehicle {few(sorted(both))} is both held out and trusted: the reference would be learnt from it"
        )
    for option, wanted in (("--branches", settings.branches is not None), ("--sensor-models", settings.sensor_models)):
        if wanted and since is not None:
            raise ContradictionError(f"{option} and --since exclude each other: the earlier result has decided on that")


def require_folder(storage: Storage, place: str | Path) -> None:
    """Refuse a place that cannot be a fleet; of a URL its storage tells."""
    if storage.is_local and not Path(storage.url).is_dir():
        if Path(storage.url).exists():
            raise FleetError(
                f"{place}: is a file; give a store of drives or of summaries, or a folder with one folder of logs per "
                f"vehicle"
            )
        raise FleetError(f"{place}: no such folder, store of drives or store of summaries")


def require_summaries_alone(storage: Storage) -> None:
    """Refuse a store of summaries in which there are drives as well: which are meant, nobody can tell."""
    drives = [name for name in (STORE_FOLDER, LOGS_FOLDER) if storage.is_local and (Path(storage.url) / name).is_dir()]
    if drives:
        raise FleetError(
            f"{storage.url}: holds drives ({few(drives)}) and summaries (summaries.json); move one of them elsewhere, "
            f"and give the folder of the other"
        )


def require_drives_unneeded(settings: CalibrationSettings, where: str) -> None:
    """Refuse what summaries do not tell."""
    needs = {
        "--method published": settings.method is Method.PUBLISHED,
        "--sensor-models": settings.sensor_models,
        "--branches": settings.branches is not None,
    }
    for option, wanted in needs.items():
        if wanted:
            raise FleetError(f"{where}: a store of summaries, and {option} needs the drives; give the drive store")


def find_drives(path: Path, settings: CalibrationSettings, *, everyone: bool) -> FleetSource:
    """Drives of a fleet; if they are everyone's, vehicles that the settings name must be among them."""
    fleet = without_copies(find_fleet(path))
    if not fleet.vehicles:
        raise FleetError(f"{path}: no drive that is one vehicle's alone{few_reasons(fleet.left_out)}")
    for names, what in ((settings.hold_out, "hold out"), (settings.trusted, "trust")):
        unknown = sorted(names - fleet.vehicles.keys()) if everyone else []
        if unknown:
            reasons = few_reasons({name: fleet.left_out[name] for name in unknown if name in fleet.left_out})
            there = few(sorted(fleet.vehicles))
            raise FleetError(f"{path}: no vehicle {few(unknown)} to {what}{reasons}; there are {there}")
    if everyone:
        require_learning(list(fleet.vehicles), settings, fleet.left_out)
    return fleet
