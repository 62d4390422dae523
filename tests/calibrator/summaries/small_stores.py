"""Stores of summaries of small fleets whose faults are known."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibrator.drive import Equipment
from calibrator.drives.delays import BranchDelays
from calibrator.faults import Faults
from calibrator.files.storage import Storage, open_storage
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity, store_identity, write_identity
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import Record
from calibrator.summaries.summary_store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent
from ecu_node.database import VehicleDatabase
from tests.calibrator.estimator import simulated_rows
from tests.calibrator.estimator.simulated_drives import PERIOD_S, Conditions, summaries_of

BRANCHES = ("battery", "motor")
INPUTS = ("speed", "torque", "voltage")
EQUIPMENT = Equipment(branches=BRANCHES, inputs=("speed",), fleet_inputs=INPUTS, notices=("a notice",))
CONDITIONS = Conditions(model_error_a=0.5)


def random_faults(vehicles: int) -> Faults:
    """One fault in most vehicles; every third has none."""
    drawn = simulated_rows.random_faults(0, vehicles=vehicles, branches=len(BRANCHES), full_scale_a=400.0)
    faulty = np.arange(vehicles) % 3 != 0
    return Faults(
        hardware_drift=drawn.hardware_drift * faulty,
        hardware_offset_a=drawn.hardware_offset_a * faulty[:, None],
        drift=drawn.drift * faulty[:, None],
        offset_a=drawn.offset_a * faulty[:, None],
    )


def record_of(name: str, summary: DriveSummary, drives: Sequence[str] = ("d1",), *, shown_a: float = np.nan) -> Record:
    """A record; the motor sensor showed ``shown_a`` with open contactors."""
    K = len(BRANCHES)
    found = VehicleSummary(
        vehicle=name,
        drives=tuple(drives),
        summary=replace(summary, bank=FilterBank(input_names=EQUIPMENT.fleet_inputs, period_s=PERIOD_S).identity),
        delays=BranchDelays(
            branches=("motor", "battery"),
            delay_s=np.array([0.0, 0.02]),
            sd_s=np.array([0.0, 0.001]),
            known=np.ones(K, bool),
        ),
        zero_current=ZeroCurrent(offset_a=np.array([np.nan, shown_a]), sd_a=np.array([np.nan, 0.0 * shown_a + 0.1])),
    )
    return Record(vehicle=name, drives=tuple(drives), sources=("1-2",) * len(drives), found=found)


def identity_of(database: VehicleDatabase, vehicles: int) -> StoreIdentity:
    bank = FilterBank(input_names=EQUIPMENT.fleet_inputs, period_s=PERIOD_S)
    return store_identity(EQUIPMENT, database, vehicles=vehicles, fleet="small", bank=bank)


def small_store(storage: Storage | Path, database: VehicleDatabase, faults: Faults) -> SummaryStore:
    """A store of vehicles V000 and so on, one drive each."""
    place = open_storage(storage) if isinstance(storage, Path) else storage
    store = SummaryStore(storage=place, identity=identity_of(database, len(faults)))
    write_identity(place, store.identity)
    names = [f"V{j:03d}" for j in range(len(faults))]
    summaries = dict(zip(names, summaries_of(faults, CONDITIONS, seed=1), strict=True))
    for bucket, inside in store.by_bucket(names).items():
        store.append(bucket, [record_of(name, summaries[name]) for name in inside])
    return store


def fullest(store: SummaryStore) -> int:
    """Bucket with most vehicles."""
    return max(store.buckets(), key=lambda bucket: len(store.outlines(bucket)))
