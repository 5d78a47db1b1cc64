"""Runs the optical calibration in many drawn worlds and prints how it did against the truth.

python scripts/bench_worlds.py                100 worlds for settling and errors, 200 for coverage
python scripts/bench_worlds.py --worlds 20    quicker
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

NAMES = ("p11", "p12", "p13", "p21", "p22", "p23")


def run_world(seed: int) -> dict[str, Any]:
    """Calibrate in one world."""
    import cv2

    from microdrivers.configs import shipped_rig
    from microdrivers.core.clock import SimulatedClock, utc_now
    from microdrivers.core.errors import MicrodriversError
    from microdrivers.estimators.optics import student_factor
    from microdrivers.report.truth import OpticsTruthCollector
    from microdrivers.rig import open_rig
    from microdrivers.routines.optics import CircleExperiment, calibrate_optics
    from microdrivers.routines.optics.calibration import build_result
    from microdrivers.routines.provenance import describe_run

    cv2.setNumThreads(1)
    with open_rig(shipped_rig(), fake=True, seed=seed, clock=SimulatedClock()) as rig:
        source = CircleExperiment(rig)
        truth = OpticsTruthCollector(source.bus)
        try:
            run = calibrate_optics(source)
        except MicrodriversError as error:
            return {"seed": seed, "failed": str(error)}
        result = build_result(run, describe_run({"source": "bench", "clock": "simulated"}, command="", now=utc_now()))
        known = truth.compare(result, run.estimates)
        # Against the truth frame by frame, from the first valid estimate after the change on.
        later = [
            e
            for e in run.estimates
            if e.valid and result.zoom_change and e.frame_index > result.zoom_change.last_moving_frame
        ]
        forty_on = later[min(39, len(later) - 1)]
    assert known is not None
    change = result.zoom_change
    sigma = np.sqrt(np.diag(np.array(result.covariance)))
    half_width = student_factor(result.degrees_of_freedom)
    angle_error = (forty_on.angle_deg - known.angle_deg + 180.0) % 360.0 - 180.0
    return {
        "seed": seed,
        "prior": change.iterations_to_0p1_px if change else None,
        "prior_from_end": change.iterations_to_0p1_px_from_end if change else None,
        "moving_frames": change.last_moving_frame - change.first_frame + 1 if change else 0,
        "scale_percent": 100.0 * (forty_on.scale_px_per_um / known.scale_px_per_um - 1.0),
        "angle_deg": angle_error,
        "covered": np.abs(np.array(known.errors["projection"])) <= half_width * sigma,
        "final_scale_ppm": 1e6 * (result.scale_px_per_um / known.scale_px_per_um - 1.0),
        "final_scale_half_width_ppm": 1e6 * half_width * result.scale_sigma_px_per_um / result.scale_px_per_um,
        "tilt_covered": result.tilt.interval_deg[0] <= known.tilt_deg <= result.tilt.interval_deg[1],
        "view_right": result.view == known.view,
        "lost": result.lost_frames,
        "unmatched": result.unmatched_frames,
    }


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=200, help="worlds to draw (default 200)")
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    begun = time.perf_counter()
    seeds = range(options.first_seed, options.first_seed + options.worlds)
    with ProcessPoolExecutor(options.jobs) as pool:
        outcomes = list(pool.map(run_world, seeds))
    failed = [outcome for outcome in outcomes if "failed" in outcome]
    good = [outcome for outcome in outcomes if "failed" not in outcome]
    print(f"{len(outcomes)} worlds, seeds {seeds[0]}–{seeds[-1]}, in {time.perf_counter() - begun:.0f} s")
    for outcome in failed:
        print(f"  seed {outcome['seed']} failed: {outcome['failed']}")
    if not good:
        return 1
    iterations = np.array([math.inf if o["prior"] is None else o["prior"] for o in good])
    print("iterations to 0.1 px (a priori, from the first frame exposed after the zoom began to move)")
    for value in sorted(set(iterations.tolist())):
        print(f"  {value:>5g}: {int(np.sum(iterations == value))}")
    share = np.sum(iterations <= 8) / len(outcomes)
    moving = sorted({outcome["moving_frames"] for outcome in good})
    print(f"  ≤ 8 in {100 * share:.1f} % of all worlds; zoom moving over {moving} frames")
    for key, unit in (("scale_percent", "%"), ("angle_deg", "°")):
        errors = np.abs([o[key] for o in good])
        print(f"|{key}| 40 frames later: median {np.median(errors):.4f} {unit}, 95 of 100 within "
              f"{np.percentile(errors, 95):.4f} {unit}, largest {errors.max():.4f} {unit}")  # fmt: skip
    covered = np.mean([o["covered"] for o in good], axis=0)
    print(
        "95 % intervals of P cover the truth: "
        + ", ".join(f"{n} {100 * c:.1f} %" for n, c in zip(NAMES, covered, strict=True))
    )
    errors_ppm, half_widths_ppm = (
        np.array([o[key] for o in good]) for key in ("final_scale_ppm", "final_scale_half_width_ppm")
    )
    print(f"that of the magnification in {100 * np.mean(np.abs(errors_ppm) <= half_widths_ppm):.1f} %, mean error "
          f"{errors_ppm.mean():.1f} ± {errors_ppm.std() / math.sqrt(len(errors_ppm)):.1f} ppm, interval "
          f"± {half_widths_ppm.mean():.0f} ppm")  # fmt: skip
    print(f"tilt interval covers in {100 * np.mean([o['tilt_covered'] for o in good]):.1f} %; "
          f"view right in {100 * np.mean([o['view_right'] for o in good]):.1f} %; "
          f"frames lost {sum(o['lost'] for o in good)}, unmatched {sum(o['unmatched'] for o in good)}")  # fmt: skip
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
