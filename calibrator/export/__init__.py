"""A parameter file taken to other tools (DCM, CDFX, CSV) and to control units without Python (C99)."""
