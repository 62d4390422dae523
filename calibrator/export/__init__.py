"""A parameter file taken to other tools (A2L, DCM, CDFX, CSV) and to control units without Python (C, HEX)."""
