"""A parameter file taken to other tools (A2L, DCM, CDFX) and to control units without Python (C, HEX)."""
