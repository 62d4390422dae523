"""What the posterior says of one vehicle, written down as its parameters."""

from collections.abc import Sequence
from typing import cast

import numpy as np

from calibrator.files.parameter_files import RunIdentity, by_branch, current_moments, junction_residual
from calibrator.posterior.advice import advise
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.explain import explanations
from calibrator.posterior.verdict import Deployment
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.parameters import (
    BranchParameters,
    Explanation,
    HardwareFault,
    HeldBack,
    VehicleParameters,
)

__all__ = ["impossible_vehicles", "vehicle_parameters"]

UNTOLD = 0.05
"""Probability of other explanations up to which they are not told. [1]"""
MOST_TOLD, LEAST_TOLD = 3, 0.02
"""Explanations that are told, and the least probability of one after the first. [1]"""


def impossible_vehicles(posterior: FleetPosterior, branches: Sequence[str]) -> dict[int, str]:
    """Vehicles whose currents no sensor can show.

    Parameters
    ----------
    posterior : FleetPosterior
        Of N vehicles.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    dict of int to str
        Why each has no parameters, by position.
    """
    possible = np.abs(posterior.faults.drift) < 1.0
    return {
        j: (
            f"its {branches[int(np.argmin(possible[j]))]} current does not follow its inputs as in the rest of the "
            f"fleet: parked, stuck, or another kind of vehicle? record a drive in which it is used"
        )
        for j in np.flatnonzero(~possible.all(axis=1)).tolist()
    }


def vehicle_parameters(
    vehicle: VehicleSummary,
    posterior: FleetPosterior,
    deployment: Deployment,
    *,
    position: int,
    branches: Sequence[str],
    identity: RunIdentity,
    fleet_size: int,
) -> VehicleParameters:
    """Write down what was found for one vehicle.

    Parameters
    ----------
    vehicle : VehicleSummary
        The vehicle.
    posterior, deployment : FleetPosterior, Deployment
        Of it and others.
    position : int
        Which of them it is.
    branches : sequence of str
        Names of the K branches.
    identity : RunIdentity
        Of the run.
    fleet_size : int
        Vehicles of the fleet.

    Returns
    -------
    VehicleParameters
        As its parameter file says it.
    """
    j = position
    faults, corrected = posterior.faults.take(j), deployment.corrected[j]
    open_question = deployment.verdicts[j] == "cannot tell" or posterior.confidence[j] < 1.0 - UNTOLD
    told: list[Explanation] = []
    decisive = ""
    if open_question or (deployment.held_back[j] != "").any():
        told, decisive = _explanations(posterior, deployment, j, branches, identity)
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=identity.layout,
        dbc=identity.dbc,
        verdict=deployment.verdicts[j],
        confidence=None if posterior.health and posterior.health.doubtful else _share(posterior.confidence[j]),
        branches={name: _branch(vehicle, posterior, deployment, (j, k), name=name) for k, name in enumerate(branches)},
        hardware_fault=HardwareFault(
            suspected=bool(deployment.hardware[j]),
            drift=float(faults.hardware_drift),
            offset_a=by_branch(branches, faults.hardware_offset_a),
            probability=_share(posterior.hardware_fault[j]),
        ),
        explanations=told,
        deciding_evidence=decisive,
        junction_residual=junction_residual(
            current_moments(vehicle.summary.mean_a, vehicle.summary.mean_product_a2),
            gain=np.where(corrected, 1.0 + faults.drift, 1.0)[None],
            offset_a=np.where(corrected, faults.offset_a, 0.0),
            expected_a=posterior.health.unmeasured_a if posterior.health is not None else 0.0,
        ),
        provenance=identity.provenance(
            fleet_size=fleet_size, drives=vehicle.drives, duration_s=vehicle.summary.duration_s
        ),
    )


def _branch(
    vehicle: VehicleSummary, posterior: FleetPosterior, deployment: Deployment, place: tuple[int, int], *, name: str
) -> BranchParameters:
    k = vehicle.delays.branches.index(name)
    known = bool(vehicle.delays.known[k])
    in_doubt = posterior.health is not None and place[1] in posterior.health.doubtful
    return BranchParameters(
        drift=float(posterior.faults.drift[place]),
        offset_a=float(posterior.faults.offset_a[place]),
        drift_sd=float(posterior.drift_sd[place]),
        offset_sd_a=float(posterior.offset_sd_a[place]),
        apply=bool(deployment.corrected[place]),
        held_back=cast("HeldBack", str(deployment.held_back[place])) if deployment.held_back[place] else None,
        delay_s=float(vehicle.delays.delay_s[k]) if known else None,
        delay_sd_s=float(vehicle.delays.sd_s[k]) if known else None,
        fault_probability=None if in_doubt else _share(posterior.sensor_fault[place]),
        harm_probability=None if in_doubt else _share(posterior.harm[place]),
        identifiable=bool(posterior.identifiable[place]),
    )


def _explanations(
    posterior: FleetPosterior, deployment: Deployment, j: int, branches: Sequence[str], identity: RunIdentity
) -> tuple[list[Explanation], str]:
    """The competing explanations of one vehicle, and what would decide between them."""
    layout = identity.database.layout
    names = [branches[k] for k in posterior.order]
    found = explanations(posterior.states, j)
    told = [
        Explanation(
            probability=_share(each.probability),
            drift={name: float(d) for name, d in zip(names, each.drift, strict=True) if d},
            offset_a={name: float(o * layout.full_scale_a) for name, o in zip(names, each.offset, strict=True) if o},
            hardware_drift=each.hardware_drift,
            hardware_offset_a={
                name: float(o * layout.full_scale_a) for name, o in zip(names, each.hardware_offset, strict=True) if o
            },
        )
        for n, each in enumerate(found[:MOST_TOLD])
        if not n or each.probability >= LEAST_TOLD
    ]
    return told, advise(posterior, deployment, j, found, branches=branches, layout=layout)


def _share(value: float) -> float:
    """A probability, free of rounding beyond its range."""
    return float(np.clip(value, 0.0, 1.0))
