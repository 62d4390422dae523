"""The project's own layout and DBC, but with timeouts that a slow kernel keeps."""

import re
import shutil
from pathlib import Path

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
TIMEOUT_S = 5.0
"""Branches are stale after this. [s]"""


def write_patient_layout(folder: Path, *, timeout_s: float = TIMEOUT_S) -> Path:
    """Write layout and DBC into an existing folder; returns the layout's path."""
    shutil.copy(LAYOUT.with_suffix(".dbc"), folder)
    path = folder / LAYOUT.name
    path.write_text(re.sub(r"(?m)^timeout_s = [0-9.]+$", f"timeout_s = {timeout_s}", LAYOUT.read_text()))
    return path
