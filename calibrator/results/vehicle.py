"""Parameters of one vehicle, found in a result."""

from pathlib import Path

from calibrator.errors import FleetError
from calibrator.results.left_out import left_out_reason
from calibrator.results.parameter_parts import PARTS, Written, read_part
from calibrator.results.run_record import read_run
from calibrator.summaries.buckets import bucket_of

__all__ = ["parameters_of", "written_of"]


def parameters_of(result: Path, vehicle: str) -> bytes:
    """Text of the parameter file of one vehicle, as :func:`written_of`."""
    return written_of(result, vehicle).text


def written_of(result: Path, vehicle: str) -> Written:
    """Parameters of one vehicle.

    Parameters
    ----------
    result : Path
        Folder of a result.
    vehicle : str
        Name.

    Returns
    -------
    Written
        With the text as the node reads it.

    Raises
    ------
    FleetError
        If it is no result, or there are no parameters of this vehicle in it.
    """
    run = read_run(result)
    number = bucket_of(vehicle, run.buckets) if run.buckets else 0
    found = read_part(result / PARTS / f"{number:05d}.parquet")
    if vehicle not in found:
        if not (result / PARTS).is_dir():
            raise FleetError(f"{result / PARTS}: no such folder; give all that 'calibrator calibrate' wrote")
        why = left_out_reason(result / "results.parquet", vehicle)
        if why is None:
            raise FleetError(f"{result}: no vehicle {vehicle!r} in it; results.parquet names all that are")
        raise FleetError(f"{result}: no parameters of vehicle {vehicle!r}, it was left out: {why}")
    return found[vehicle]
