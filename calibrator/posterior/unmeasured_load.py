"""Load that no branch measures, as the junction's constant of a fleet tells it."""

from dataclasses import replace

from calibrator.drive import Array
from calibrator.evidence.cluster import Cluster, densest_clusters
from calibrator.posterior.slab import FAULTS_RANGE

__all__ = ["LAWFUL", "LAWFUL_CONSTANT", "LAWFUL_GAIN", "MOST_UNMEASURED", "unmeasured_load"]

LAWFUL, LAWFUL_GAIN, LAWFUL_CONSTANT = 3.0, 0.001, 0.002
"""Deviations up to which a vehicle obeys the junction law, and the least one of a gain ratio and the constant. [1]"""
LEAST_AGREEING_LOAD = 0.15
"""Share of the vehicles that must agree on a load without a sensor. [1]"""
MOST_UNMEASURED = 0.015
"""Largest load without a sensor that is looked for, over full scale; larger constants are offsets. [1]"""


def unmeasured_load(constant: Array, sd: Array) -> Cluster:
    """Densest cluster of the junction's constant among those that a load without a sensor can make.

    Parameters
    ----------
    constant, sd : ndarray of shape (N,)
        Constants of N vehicles in fractions of full scale, and their standard deviations. [1]

    Returns
    -------
    Cluster
        At zero if too few vehicles agree for such a load to be taken for granted.
    """
    possible = constant > -LAWFUL_CONSTANT - LAWFUL * sd
    for found in densest_clusters(constant[possible], sd[possible], farthest=MOST_UNMEASURED, widest=FAULTS_RANGE):
        share = found.share * float(possible.mean())
        if share >= LEAST_AGREEING_LOAD and found.centre > -LAWFUL_CONSTANT:
            return replace(found, share=share)
    return Cluster(centre=0.0, spread=0.0, share=0.0, gain=0.0)
