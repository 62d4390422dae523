"""A calibration of a whole fleet: two passes over fixed chunks, on any number of processes or machines."""
