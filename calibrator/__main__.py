"""``python -m calibrator`` is the command ``calibrator``."""

from calibrator.cli import main

main()
