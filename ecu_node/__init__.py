"""On-board side: the layout, the parameter file and the node that corrects high-voltage currents on a CAN bus."""

__all__ = ["__version__"]

__version__ = "1.1.0"
