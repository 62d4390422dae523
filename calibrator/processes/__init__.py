"""Run functions in worker processes, and end these and the program at signals."""
