"""Sparse posterior over hardware and sensor faults: the default estimator."""
