"""Export a parameter file to calibration tools (A2L, DCM, CDFX) and to control units without Python (C, HEX)."""
