"""The project's own layout and DBC, but with timeouts that a slow kernel keeps, and no distrust after a pause of it."""

import re
import shutil
from pathlib import Path

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
TIMEOUT_S = 5.0
"""Timeout of all branches. [s]"""
_TRUSTED_AT_ONCE = "invalid = {window = 10, min_ok = 1, max_error = 1}"
"""One intact frame after a silence is enough: whether a kernel pauses for longer than that is chance."""


def write_patient_layout(folder: Path) -> Path:
    """Write layout and DBC into an existing folder; returns the layout's path."""
    shutil.copy(LAYOUT.with_suffix(".dbc"), folder)
    path = folder / LAYOUT.name
    patient = re.sub(r"(?m)^timeout_s = [0-9.]+$", f"timeout_s = {TIMEOUT_S}", LAYOUT.read_text())
    path.write_text(patient.replace('profile = "P01"\n', f'profile = "P01"\n{_TRUSTED_AT_ONCE}\n', 1))
    return path
