#!/usr/bin/env python3
"""The command 'calibrator kirchhoff', under the name it had."""

import sys

from calibrator.__main__ import main

if __name__ == "__main__":
    sys.argv.insert(1, "kirchhoff")
    main()
