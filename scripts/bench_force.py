"""How well specimens are identified from simulated indentations, and from a real one, each beside what must be reached.

    python scripts/bench_force.py [--share 1.0] [--workers 2]

Takes four minutes on two quiet cores. `--share 0.1` runs a tenth of the records: too few to judge intervals and
efficiency by. See bench_force/ for how.
"""

import os
import sys

# The matrices are small: threads of the linear algebra only get in each other's way. Before numpy is loaded.
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from bench_force.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
