"""`calibrate optics` on a rig that another process serves, against the same world in process.

Three commands of the command line, as a user types them: `serve`, `reference`, `calibrate optics --rig`; and
`calibrate optics --seed` for the run in process, on a simulated clock. Both runs state 95 % intervals; their difference
is compared with the interval of that difference.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path

from bench_wires.figures import Figure
from microdrivers.configs import shipped_rig
from microdrivers.estimators.optics import student_factor
from microdrivers.results.optics import OpticsResult, read_result

_PROGRAM = [sys.executable, "-m", "microdrivers"]
_QUANTITIES = (
    ("scale", "scale_px_per_um", "scale_sigma_px_per_um", "px/µm", 6),
    ("angle", "angle_deg", "angle_sigma_deg", "°", 4),
)


def measure(seeds: int) -> list[Figure]:
    """One world after the other; says on the way how far it is, for it takes real time."""
    figures = []
    ratios: list[float] = []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory(prefix="bench-wires-") as folder:
            served, how = _served(seed, Path(folder))
            here = _in_process(seed, Path(folder))
        for name, value, sigma, unit, digits in _QUANTITIES:
            difference = _difference(getattr(served, value), getattr(here, value), angle=unit == "°")
            halves = [student_factor(r.degrees_of_freedom) * getattr(r, sigma) for r in (served, here)]
            both = math.hypot(*halves)
            ratios.append(abs(difference) / both)
            figures.append(
                Figure(
                    f"  world {seed}, {how}: {name}, served − in process",
                    f"± {both:.{digits}f} {unit}",
                    f"{difference:+.{digits}f} {unit}; stated ± {halves[0]:.{digits}f} served, "
                    f"± {halves[1]:.{digits}f} in process",
                )
            )
            print(f"{figures[-1].name}: {figures[-1].measured}", flush=True)
    inside = sum(ratio <= 1.0 for ratio in ratios)
    summary = Figure(
        "calibrate optics --rig served.yaml from a second process",
        "within the stated uncertainty of the run in process",
        f"{inside} of {len(ratios)} estimates within 95 %, the farthest at {max(ratios):.2f} of its interval",
        inside >= _fewest_inside(len(ratios)),
    )
    return [summary, *figures]


def _fewest_inside(number: int) -> int:
    """Of so many estimates, as many lie within their 95 % intervals in all but one of a hundred sound benches."""
    outside, probability = 0, 0.95**number
    while probability < 0.99:
        outside += 1
        probability += math.comb(number, outside) * 0.05**outside * 0.95 ** (number - outside)
    return number - outside


def _served(seed: int, folder: Path) -> tuple[OpticsResult, str]:
    rig, out = folder / "served.yaml", folder / "served"
    serve = [*_PROGRAM, "serve", str(shipped_rig()), "--seed", str(seed), "--write", str(rig)]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as serving:
        try:
            assert serving.stdout is not None
            while not serving.stdout.readline().startswith("serving"):
                if serving.poll() is not None:
                    raise SystemExit("the rig could not be served")
            _run(["reference", str(rig), "--axes", "x,y,theta", "--yes"])
            said = _run(["calibrate", "optics", "--rig", str(rig), "--out", str(out)])
        finally:
            serving.terminate()
    return read_result(out / "result.json"), "at rest" if "at rest" in said else "in motion"


def _in_process(seed: int, folder: Path) -> OpticsResult:
    out = folder / "in-process"
    _run(["calibrate", "optics", "--seed", str(seed), "--out", str(out)])
    return read_result(out / "result.json")


def _run(arguments: list[str]) -> str:
    done = subprocess.run([*_PROGRAM, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"microdrivers {' '.join(arguments)} failed:\n{done.stderr}")
    return done.stderr


def _difference(one: float, other: float, *, angle: bool) -> float:
    return math.remainder(one - other, 360.0) if angle else one - other
