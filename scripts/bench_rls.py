"""Measures the projection recursion: speed, exactness, stability, and whether its 95 % intervals cover.

Run as `python scripts/bench_rls.py` with the package installed; it takes about 3 s.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.optics import ProjectionRecursion, optical_parameters

Array = npt.NDArray[np.float64]

CENTRE_UM = (7500.0, 7500.0)
RADIUS_UM = 300.0
SCALE_PX_PER_UM = 0.243
ANGLE_DEG = 37.0
TRACKING_PX = 0.0095
POSE_UM = 0.0175
STEP_RAD = math.radians(4.0)
SPEED_RAD_S = STEP_RAD * 30.0
RIDGE = 1e-9


def true_projection() -> Array:
    """P (2 × 3) of a camera that looks down: the image of +Y is mirrored."""
    c, s = math.cos(math.radians(ANGLE_DEG)), math.sin(math.radians(ANGLE_DEG))
    A = SCALE_PX_PER_UM * np.array([[c, s], [s, -c]])
    return np.column_stack([A, np.array([12.0, -8.0]) - A @ CENTRE_UM])


def semicircle(rng: np.random.Generator, frames: int, offset_s: float = 0.0) -> tuple[Array, Array, Array]:
    """Encoder poses (µm), image points (px) and velocities (µm/s) along the arc, with noise."""
    turn = rng.uniform(0.0, 2.0 * math.pi) + STEP_RAD * np.arange(frames)

    def pose(at: npt.NDArray[np.floating]) -> Array:
        return np.array(CENTRE_UM) + RADIUS_UM * np.column_stack([np.cos(at), np.sin(at)])

    P = true_projection()
    xy = pose(turn) + POSE_UM * rng.standard_normal((frames, 2))
    uv = pose(turn + SPEED_RAD_S * offset_s) @ P[:, :2].T + P[:, 2]
    uv += TRACKING_PX * rng.standard_normal((frames, 2))
    velocity = RADIUS_UM * SPEED_RAD_S * np.column_stack([-np.sin(turn), np.cos(turn)])
    return xy, uv, velocity


def new_recursion() -> ProjectionRecursion:
    """The recursion in the coordinates of the arc."""
    return ProjectionRecursion(centre_um=CENTRE_UM, scale_um=RADIUS_UM, ridge=RIDGE)


def speed(updates: int, repeats: int) -> None:
    """Time per update, its bookkeeping for the covariance included."""
    xy, uv, velocity = (array.tolist() for array in semicircle(np.random.default_rng(0), updates))
    rows = [(*p, *q, *w) for p, q, w in zip(xy, uv, velocity, strict=True)]
    figures = []
    for _ in range(repeats):
        estimator = new_recursion()
        begin = time.perf_counter()
        for x, y, u, v, vx, vy in rows:
            estimator.update(x_um=x, y_um=y, u_px=u, v_px=v, forgetting=0.99, vx_um_s=vx, vy_um_s=vy, sigma_time_s=1e-4)
        figures.append((time.perf_counter() - begin) / updates * 1e6)
    begin = time.perf_counter()
    for _ in range(500):
        estimator.uncertainty()
    reading = (time.perf_counter() - begin) / 500 * 1e6
    best, median = min(figures), np.median(figures)
    print(f"update with solution: {best:.2f} µs best, {median:.2f} µs median of {repeats} runs")
    print(f"covariance on demand: {reading:.0f} µs")


def exactness(frames: int) -> None:
    """Recursive estimate against eqs. (14)–(16) summed up from all data."""
    rng = np.random.default_rng(1)
    xy, uv, _ = semicircle(rng, frames)
    factors = np.where(rng.uniform(size=frames) < 0.02, 0.0, rng.uniform(0.95, 1.0, frames))
    factors[-60:] = 0.99
    estimator = new_recursion()
    for (x, y), (u, v), factor in zip(xy.tolist(), uv.tolist(), factors.tolist(), strict=True):
        estimator.update(x_um=x, y_um=y, u_px=u, v_px=v, forgetting=factor)
    X = np.column_stack([(xy - CENTRE_UM) / RADIUS_UM, np.ones(frames)])
    R, f = np.zeros((3, 3)), np.zeros((3, 2))
    for k in range(frames):
        beta = np.prod(factors[k + 1 :])
        stack = slice(max(0, k - 2), k + 1)
        R += beta * (X[stack].T @ X[stack] + RIDGE * np.eye(3))
        f += beta * (X[stack].T @ uv[stack])
    batch = np.linalg.solve(R, f).T.ravel()
    worst = np.abs(np.array(estimator.theta) - batch).max()
    relative = worst / np.linalg.norm(batch)
    print(f"max |recursive − batch|: {worst:.1e} px, relative {relative:.1e} ({frames} frames)")


def stability(updates: int) -> None:
    """Two regressors collinear to 1e-6 for a long time."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, updates)
    y = x + 1e-6 * rng.standard_normal(updates)
    noise = TRACKING_PX * rng.standard_normal((updates, 2))
    estimator = new_recursion()
    largest = 0.0
    for a, b, (du, dv) in zip(x.tolist(), y.tolist(), noise.tolist(), strict=True):
        estimator.update(
            x_um=CENTRE_UM[0] + RADIUS_UM * a,
            y_um=CENTRE_UM[1] + RADIUS_UM * b,
            u_px=73.0 * a + du,
            v_px=-73.0 * a + dv,
            forgetting=0.98,
        )
        size = max(map(abs, estimator.theta))
        largest = size if not size <= largest else largest
    along = estimator.theta[0] + estimator.theta[1]
    print(
        f"{updates} near-singular updates: max |θ| {largest:.1f} px, finite: {math.isfinite(largest)}, "
        f"θ along the line {along:.4f} (true 73), condition {estimator.condition:.1e}, "
        f"determined: {estimator.is_determined}"
    )


def coverage(runs: int, frames: int, sigma_time_s: float) -> None:
    """Share of runs whose 95 % interval holds the truth, `frames` after a zoom change with a full flush."""
    rng = np.random.default_rng(3)
    truth = true_projection().ravel()
    inside = np.zeros(6)
    scale_inside = angle_inside = tilt_inside = 0
    sigma_scale, sigma_angle, bounds = [], [], []
    for _ in range(runs):
        offset = sigma_time_s * rng.standard_normal()
        xy, uv, velocity = semicircle(rng, 45 + frames, offset)
        uv[:45] *= 0.9 / 1.2
        estimator = new_recursion()
        for k in range(45 + frames):
            estimator.update(
                x_um=float(xy[k, 0]),
                y_um=float(xy[k, 1]),
                u_px=float(uv[k, 0]),
                v_px=float(uv[k, 1]),
                forgetting=0.0 if 45 <= k < 48 else 0.99,
                vx_um_s=float(velocity[k, 0]),
                vy_um_s=float(velocity[k, 1]),
                sigma_time_s=sigma_time_s,
            )
        found = estimator.uncertainty()
        if found is None:
            raise SystemExit("no uncertainty after the run")
        factor = found.interval_factor()
        error = np.abs(np.array(estimator.projection) - truth)
        inside += error <= factor * np.sqrt(np.diag(found.covariance))
        optics = optical_parameters(estimator.projection, found.covariance, degrees_of_freedom=found.degrees_of_freedom)
        s_scale, s_angle = optics.sigma_scale_px_per_um or 0.0, optics.sigma_angle_deg or 0.0
        scale_inside += abs(optics.scale_px_per_um - SCALE_PX_PER_UM) <= factor * s_scale
        angle_inside += abs(optics.angle_deg - ANGLE_DEG) <= factor * s_angle
        tilt_inside += optics.tilt_deg_interval[0] == 0.0
        sigma_scale.append(s_scale / SCALE_PX_PER_UM)
        sigma_angle.append(s_angle)
        bounds.append(optics.tilt_deg_interval[1])
    shares = " ".join(f"{100 * n / runs:.1f}" for n in inside)
    print(
        f"coverage of 95 % intervals, {runs} runs, σ_time {sigma_time_s * 1e3:g} ms, in %: P {shares}, "
        f"scale {100 * scale_inside / runs:.1f}, angle {100 * angle_inside / runs:.1f}, "
        f"tilt {100 * tilt_inside / runs:.1f}"
    )
    print(
        f"  σ of scale {np.mean(sigma_scale):.1e} relative, of angle {np.mean(sigma_angle):.4f}°, "
        f"95 % bound of tilt {np.median(bounds):.2f}° (true 0)"
    )


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200, help="simulated runs for the coverage")
    parser.add_argument("--frames", type=int, default=40, help="frames after the zoom change")
    arguments = parser.parse_args()
    speed(updates=20_000, repeats=7)
    exactness(frames=2000)
    stability(updates=100_000)
    for sigma_time_s in (0.0, 2e-4):
        coverage(arguments.runs, arguments.frames, sigma_time_s)


if __name__ == "__main__":
    main()
