"""Artificial fleets: trips, faults, and the CAN logs that vehicles with such faults write."""
