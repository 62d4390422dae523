"""On-board side: the layout, the parameter file and the node that corrects high-voltage currents on a CAN bus."""

__all__ = ["__version__"]

__version__ = "0.1.0"
