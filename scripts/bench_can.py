"""What CAN costs and keeps: figures of fine stage and force sensor, each beside its limit.

    python scripts/bench_can.py [move] [streams] [exchanges] [socketcan] [--seeds 5] [--repeat 1.0]

Without a name all are measured, in about a minute and a half. `socketcan` is measured on this kernel's vcan0, else in
a guest (`scripts/vcan-run --setup auto` fetches it once). See bench_can/ for how.
"""

import sys

from bench_can.cli import main

if __name__ == "__main__":
    sys.exit(main())
