"""Nodes of a slab, for any number of open directions, as compiled functions take them."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from calibrator.drive import Array
from calibrator.posterior.normal import Places
from calibrator.posterior.slab import Slab

__all__ = ["SlabNodes", "slab_nodes"]


class SlabNodes(NamedTuple):
    """A slab, and its nodes for 0 .. D open directions; both logarithms and values where they stand for drifts.

    The first ``hardware`` parameters are the hardware's, of which none is smaller than the slab. No density is larger
    than the one whose logarithm is ``log_density``.

    ``values`` (D + 1, Q, D), of which ``counts[d]`` are used; ``sd`` (D + 1, Q, D) what each stands for; ``spacing``
    (D + 1,) how far they lie apart if there is one direction more.
    """

    low: float
    high: float
    smaller: float
    log_density: float
    logarithmic: bool
    hardware: int
    counts: Places
    values: Array
    sd: Array
    spacing: Array


def slab_nodes(slab: Slab, directions: int, *, logarithmic: bool, hardware: int) -> SlabNodes:
    """Nodes of a slab for up to so many open directions.

    Parameters
    ----------
    slab : Slab
        Of drifts or offsets.
    directions : int
        Most directions that can be open.
    logarithmic : bool
        Whether the rows are linear in the logarithm of 1 + parameter.
    hardware : int
        How many of the parameters, the first ones, are the hardware's.

    Returns
    -------
    SlabNodes
        For compiled functions.
    """
    units = [_unit_nodes(d) for d in range(directions + 1)]
    most = max(len(unit) for unit in units)
    values, sd = np.zeros((directions + 1, most, directions)), np.zeros((directions + 1, most, directions))
    for d, unit in enumerate(units):
        nodes = slab.at(unit)
        values[d, : len(unit), :d] = np.log1p(nodes) if logarithmic else nodes
        sd[d, : len(unit), :d] = slab.cell_sd(d) / (1.0 + nodes if logarithmic else 1.0)
    return SlabNodes(
        low=slab.low,
        high=slab.high,
        smaller=slab.smaller,
        log_density=float(np.log(max(replace(slab, smaller=0.0).density, slab.density_below))),
        logarithmic=logarithmic,
        hardware=hardware,
        counts=np.array([len(unit) for unit in units]),
        values=values,
        sd=sd,
        spacing=np.array([slab.spacing(d + 1) for d in range(directions + 1)]),
    )


@cache
def _unit_nodes(directions: int) -> Array:
    return Slab.unit_nodes(directions)
