"""Results whose every number is known, without a calibration."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from calibrator.estimator import results
from calibrator.estimator.evidence import evidence_names
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, Explanation, HardwareFault, JunctionResidual, VehicleParameters
from tests.ecu_node.vehicles import parameters_for

BRANCHES = ("battery", "motor")
FULL_SCALE_A = 400.0
EVIL = "<script>document.title='run'</script>"
RUN = results.RunRecord(
    tool="calibrator test",
    fleet="at hand",
    method="posterior",
    layout="hv_powertrain",
    branches=[*BRANCHES],
    created="2026-01-01T00:00:00+00:00",
    vehicles=2,
    full_scale_a=FULL_SCALE_A,
    settings={},
    details={},
    left_out={},
    model_inputs=[],
    notices=[],
)


def sensor(
    drift: float = 0.0, offset_a: float = 0.0, *, apply: bool = False, held_back: str | None = None, sd: float = 0.001
) -> BranchParameters:
    """A sensor with this fault; its gain error has the standard deviation ``sd``, its offset 100 A times ``sd``."""
    faulty = drift != 0.0 or offset_a != 0.0
    return BranchParameters(
        drift=drift,
        offset_a=offset_a,
        drift_sd=sd,
        offset_sd_a=100.0 * sd,
        apply=apply,
        held_back=held_back,  # type: ignore[arg-type]
        delay_s=0.02,
        delay_sd_s=0.001,
        fault_probability=0.995 if faulty else 0.004,
        harm_probability=0.0002 if faulty else 0.0,
    )


def vehicle(
    database: VehicleDatabase,
    name: str,
    battery: BranchParameters,
    motor: BranchParameters,
    *,
    verdict: str = "corrected",
    sums_a: tuple[float, float] = (10.0, 1.0),
    hardware: HardwareFault | None = None,
    explanations: Sequence[Explanation] = (),
    decides: str = "",
) -> VehicleParameters:
    """Parameters of a vehicle with two branches."""
    plain = parameters_for(database, battery=(0.0, 0.0), motor=(0.0, 0.0))
    return replace(
        plain,
        vehicle=name,
        verdict=verdict,
        confidence=0.97,
        branches={"battery": battery, "motor": motor},
        hardware_fault=hardware or HardwareFault(suspected=False, probability=0.01),
        junction_residual=JunctionResidual(measured_a=sums_a[0], corrected_a=sums_a[1]),
        explanations=list(explanations),
        deciding_evidence=decides,
        provenance=replace(plain.provenance, method="posterior", fleet_size=6, drives=["d1", "d2"], duration_s=1800.0),
    )


def six_vehicles(database: VehicleDatabase) -> list[VehicleParameters]:
    """Two corrected, two without sensor fault (one with a hardware fault), two held back for different reasons."""
    make, sound, corrected = partial(vehicle, database), sensor(), partial(sensor, apply=True)
    hardware = HardwareFault(suspected=True, drift=-0.06, offset_a={"battery": 2.0, "motor": -2.0}, probability=0.97)
    rivals = [
        Explanation(probability=0.6, offset_a={"battery": 8.0}),
        Explanation(probability=0.4, drift={"motor": -0.03}, hardware_drift=0.01),
    ]
    harmful, beyond = (partial(sensor, held_back=why) for why in ("harm limit", "beyond the limits"))
    faultless: dict[str, Any] = {"verdict": "no sensor fault"}
    open_: dict[str, Any] = {"verdict": "cannot tell"}
    decides = "a zero-current window (contactors open) would decide"
    return [
        make("V1", corrected(0.1, 4.0), sound, sums_a=(24.0, 0.5)),
        make("V2", sound, sound, **faultless, sums_a=(0.4, 0.4)),
        make("V3", sound, sound, **faultless, sums_a=(0.6, 0.6), hardware=hardware),
        make("V4", harmful(0.0, 8.0, sd=0.02), sound, **open_, sums_a=(8.0, 8.0), explanations=rivals, decides=decides),
        make("V5", sound, beyond(0.45, 0.0), **open_, sums_a=(60.0, 60.0)),
        make("V10", corrected(-0.05, 0.0), corrected(0.0, -6.0), sums_a=(13.0, 0.7)),
    ]


def write_result(
    folder: Path,
    vehicles: Sequence[VehicleParameters],
    *,
    left_out: Mapping[str, str] | None = None,
    moved: Mapping[tuple[str, str], str] | None = None,
    evidence: bool = True,
) -> Path:
    """A result folder as ``calibrator calibrate`` writes it."""
    (folder / results.PARTS).mkdir(parents=True)
    rows = np.ones((3, len(evidence_names(BRANCHES))))
    rows[:2, [3, 4, 8, 9]] = np.nan  # no bench has seen these sensors
    found: dict[str, results.Calibrated | str] = dict(left_out or {})
    for item in vehicles:
        said = {branch: text for (name, branch), text in (moved or {}).items() if name == item.vehicle}
        found[item.vehicle] = results.Calibrated(item, rows if evidence else None, moved=said)
    results.part_file(folder, 0).write_bytes(results.encode_chunk(found))
    results.join_rows(folder, {})
    results.write_parameter_files(folder, vehicles=len(vehicles))
    reference = {"agreeing_share": {"battery": 0.8, "motor": 0.75}, "unmeasured_a": 0.3}
    spread = {"model_spread": {"battery": 0.004, "motor": 0.005}}
    own = {"reference": reference, "hyperparameters": spread, "evidence": evidence_names(BRANCHES)}
    lost = dict(left_out or {})
    details, notices = own if evidence else {}, [f"a notice with {EVIL}"]
    more = {"details": details, "left_out": lost, "left_out_count": len(lost), "notices": notices}
    results.write_run(folder, replace(RUN, vehicles=len(vehicles), **more))
    return folder


def six_vehicle_result(folder: Path, database: VehicleDatabase) -> Path:
    """The six vehicles, and one left out, whose name and reason are HTML code; one sensor has moved."""
    return write_result(
        folder,
        six_vehicles(database),
        left_out={f"log of {EVIL}": f"cannot be read: {EVIL}"},
        moved={("V10", "motor"): "offset +0.00 A -> -6.00 A"},
    )
