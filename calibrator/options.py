"""Choices that the command line and the calibration share."""

from enum import StrEnum

__all__ = ["Classifier", "ExperimentName", "ExportFormat", "Method"]


class Method(StrEnum):
    """How sensor faults are estimated."""

    POSTERIOR = "posterior"
    PUBLISHED = "published"


class Classifier(StrEnum):
    """How the published method tells vehicles with hardware faults, section III-B of the paper."""

    THRESHOLD = "threshold"
    TREE = "tree"
    PERFECT = "perfect"


class ExperimentName(StrEnum):
    """Experiments of the paper (table 1, figure 7, figure 8, table 2), those beyond it, and all of them."""

    CLASSIFIER = "classifier"
    SNR = "snr"
    SPARSITY = "sparsity"
    STATESPACE = "statespace"
    ASYMMETRY = "asymmetry"
    REAL = "real"
    DELAY = "delay"
    DATA = "data"
    PHASE = "phase"
    CALIBRATION = "calibration"
    ALL = "all"


class ExportFormat(StrEnum):
    """Formats that parameters are taken to."""

    DCM = "dcm"
    CDFX = "cdfx"
    CSV = "csv"
    C99 = "c99"
