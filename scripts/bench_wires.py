"""What the wires cost: figures of drivers on ports of the operating system, each beside its limit in the same run.

    python scripts/bench_wires.py [pose] [status] [frames] [cables] [calibration] [--seeds 5] [--repeat 1.0]

Without a name all are measured, in about six minutes; `--repeat 0.2` shortens. See bench_wires/ for how.
"""

import sys

from bench_wires.cli import main

if __name__ == "__main__":
    sys.exit(main())
