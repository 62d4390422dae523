"""python-can with its writer of MF4: tests/conftest.py imports it without asammdf, which takes long."""

from importlib import reload

import can.io.mf4

reload(can.io.mf4)
