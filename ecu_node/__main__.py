"""``python -m ecu_node``."""

import sys

from ecu_node.cli import main

sys.exit(main())
