"""Accuracy and time of the vision estimators, measured on analytic images and on a real micrograph.

    python scripts/bench_tracker.py [--frames 40] [--noise 2] [--contrast 120]

The square is drawn in closed form (tests/estimators/vision/square_scene.py) at random places and angles in
640 × 480 frames, each a new random draw; errors are those of all four corners against the drawn geometry.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from microdrivers.estimators.vision import SquareFit, SquareTracker, TextureTracker, locate_square

TESTS = Path(__file__).resolve().parents[1] / "tests"


def load_scene() -> ModuleType:
    """The tests' renderer."""
    path = TESTS / "estimators" / "vision" / "square_scene.py"
    spec = importlib.util.spec_from_file_location("square_scene", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{path} cannot be loaded; run this script from a checkout")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def square_row(scene: ModuleType, rng: np.random.Generator, args: argparse.Namespace, side: float, blur: float) -> str:
    """One line of the table of squares."""
    places, images = [], []
    for _ in range(args.frames):
        centre = rng.uniform((220.0, 180.0), (420.0, 300.0))
        place = {"centre": tuple(centre), "side_px": side, "angle_deg": rng.uniform(0.0, 360.0)}
        images.append(scene.square_image(rng, **place, blur_px=blur, contrast=args.contrast, noise=args.noise))
        places.append(place)
    fits, times_ms = [], []
    for image in images:
        start = time.perf_counter()
        fits.append(locate_square(image))
        times_ms.append(1e3 * (time.perf_counter() - start))
    errors, outward, sigmas = [], [], []
    for place, fit in zip(places, fits, strict=True):
        if isinstance(fit, SquareFit):
            truth = scene.square_corners(**place)
            candidates = (fit.corners_px - np.roll(truth, row, axis=0) for row in range(4))
            error = min(candidates, key=lambda e: float(np.abs(e).max()))
            from_centre = fit.corners_px - np.array(place["centre"])
            errors.append(error)
            outward.append(np.mean(np.sum(error * from_centre, axis=1) / np.hypot(*from_centre.T)))
            sigmas.append(fit.sigma_px)
    rms = 1e3 * np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    predicted = 1e3 * np.sqrt(np.mean(np.square(sigmas)))
    mean = 1e3 * np.mean(errors, axis=(0, 1))
    bias, doubt = 1e3 * np.mean(outward), 1e3 * np.std(outward) / len(outward) ** 0.5
    return (
        f"{side:6.0f} {blur:5.1f} | {rms[0]:6.1f} {rms[1]:6.1f}  {predicted:6.1f}   | "
        f"{mean[0]:+6.1f} {mean[1]:+6.1f}  {bias:+5.1f} ± {doubt:3.1f}  | "
        f"{np.median(times_ms):5.2f} {np.min(times_ms):5.2f} | {len(fits) - len(errors):4d}"
    )


def run_on_path(scene: ModuleType, rng: np.random.Generator, path: list[dict[str, object]]) -> tuple[int, float]:
    """Frames lost by a tracker along `path`, and the RMS error per axis of its corner."""
    tracker = SquareTracker(corner=0)
    lost, errors = 0, []
    for seq, place in enumerate(path):
        point = tracker.update(scene.frame(scene.square_image(rng, **place), seq=seq))
        truth = scene.square_corners(**place)[0] - (319.5, 239.5)
        if point.found:
            errors.append((point.u_px - truth[0], point.v_px - truth[1]))
        lost += not point.found
    return lost, float(np.sqrt(np.mean(np.square(errors))))


def paths() -> Iterator[tuple[str, list[dict[str, object]]]]:
    """The rotation and the zoom ramp that a calibration meets."""
    angles = np.arange(0.0, 420.0, 6.0)
    yield (
        "rotation by 420° in steps of 6°",
        [{"centre": (310.0, 250.0), "side_px": 97.0, "angle_deg": float(angle)} for angle in angles],
    )
    frames: list[dict[str, object]] = []
    for k, scale in enumerate([0.182] * 10 + [0.20, 0.22] + [0.243] * 28):
        phi = np.deg2rad(4.0 * k)
        corner = 300.0 * scale * np.array([np.cos(phi), np.sin(phi)])
        side = 400.0 * scale
        u, v = np.array([319.5, 239.5]) + corner + 0.5 * side
        frames.append({"centre": (float(u), float(v)), "side_px": side, "angle_deg": 0.0})
    yield "circle of 300 µm, zoom 0.182 to 0.243 px/µm in 3 frames", frames


def micrograph() -> str:
    """The real texture, against its truth."""
    folder = TESTS / "data" / "micrograph_sequence"
    scene = load_scene()
    tracker = TextureTracker()
    errors, times_ms, sigmas = [], [], []
    with (folder / "truth.csv").open() as file:
        for seq, row in enumerate(csv.DictReader(file)):
            image = cv2.imread(str(folder / row["file"]), cv2.IMREAD_UNCHANGED)
            if image is None:
                raise SystemExit(f"{folder / row['file']} cannot be read")
            frame = scene.frame(image, seq=seq)
            start = time.perf_counter()
            point = tracker.update(frame)
            times_ms.append(1e3 * (time.perf_counter() - start))
            errors.append((point.u_px + 159.5 - float(row["u_px"]), point.v_px + 119.5 - float(row["v_px"])))
            sigmas.append(point.sigma_px)
    rms = 1e3 * np.sqrt(np.mean(np.square(errors), axis=0))
    return (
        f"{len(errors)} frames of 320 × 240: RMS {rms[0]:.1f} / {rms[1]:.1f} mpx (u / v), "
        f"predicted {1e3 * np.mean(sigmas):.1f}, {np.median(times_ms):.2f} ms per frame"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=40, help="frames per line of the table (default 40)")
    parser.add_argument("--contrast", type=float, default=120.0, help="grey levels, negative for a dark square")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation, grey levels")
    parser.add_argument("--sides", type=float, nargs="+", default=[73.0, 97.0], help="px")
    parser.add_argument("--blurs", type=float, nargs="+", default=[0.7, 0.9, 1.2, 2.0, 3.0], help="px")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    scene = load_scene()
    rng = np.random.default_rng(args.seed)
    square_row(scene, rng, argparse.Namespace(**{**vars(args), "frames": 3}), 80.0, 1.2)
    print(
        f"Square in 640 × 480, contrast {args.contrast:g}, noise {args.noise:g}, {args.frames} frames a line; mpx, ms"
    )
    print("  side  blur |  RMS u  RMS v predicted | mean u mean v  outwards    | median min  | lost")
    for side in args.sides:
        for blur in args.blurs:
            print(square_row(scene, rng, args, side, blur), flush=True)
    print("\nOne corner, tracked")
    for name, path in paths():
        lost, rms = run_on_path(scene, rng, path)
        print(f"  {name}: {lost} of {len(path)} frames lost, RMS {1e3 * rms:.1f} mpx per axis", flush=True)
    print("\nTexture, real micrograph\n  " + micrograph())


if __name__ == "__main__":
    main()
