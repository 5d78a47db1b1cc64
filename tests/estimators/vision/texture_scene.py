"""Analytic texture for the vision tests: a sum of plane waves, exact at any shift and scale."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Texture:
    """A random band-limited texture of 60 plane waves, wavelengths 7 to 60 px, standard deviation 30 levels."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        wavelength = np.exp(rng.uniform(np.log(7), np.log(60), 60))
        direction = rng.uniform(0, 2 * np.pi, 60)
        self._ku = 2 * np.pi / wavelength * np.cos(direction)
        self._kv = 2 * np.pi / wavelength * np.sin(direction)
        self._phase = rng.uniform(0, 2 * np.pi, 60)
        self._amplitude = 30.0 * np.sqrt(2.0 / 60)

    def grey(
        self,
        *,
        shift: tuple[float, float] = (0.0, 0.0),
        scale: float = 1.0,
        angle_deg: float = 0.0,
        shape: tuple[int, int] = (240, 320),
    ) -> Array:
        """Grey levels about zero; content moves by `shift` (u, v), grows and turns about the image centre."""
        u = np.arange(shape[1]) - (shape[1] - 1) / 2 - shift[0]
        v = np.arange(shape[0]) - (shape[0] - 1) / 2 - shift[1]
        c, s = np.cos(np.deg2rad(angle_deg)) / scale, np.sin(np.deg2rad(angle_deg)) / scale
        along_u = np.outer(u, self._ku * c - self._kv * s)
        along_v = np.outer(v, self._ku * s + self._kv * c) + self._phase
        both_v = np.hstack([np.cos(along_v), -np.sin(along_v)])
        both_u = np.hstack([np.cos(along_u), np.sin(along_u)])
        # Not by @: the threads of BLAS and OpenCV would wait for each other.
        return self._amplitude * np.einsum("vk,uk->vu", both_v, both_u)
