"""Parts of `scripts/bench_force.py`."""
