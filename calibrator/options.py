"""Choices that the command line and the calibration share."""

from enum import StrEnum

__all__ = ["Classifier", "ExportFormat", "Method"]


class Method(StrEnum):
    """How sensor faults are estimated."""

    POSTERIOR = "posterior"
    PUBLISHED = "published"


class Classifier(StrEnum):
    """How the published method tells vehicles with hardware faults, section III-B of the paper."""

    THRESHOLD = "threshold"
    TREE = "tree"
    PERFECT = "perfect"


class ExportFormat(StrEnum):
    """Formats that parameters are taken to."""

    C = "c"
    HEX = "hex"
    A2L = "a2l"
    DCM = "dcm"
    CDFX = "cdfx"
    CSV = "csv"
