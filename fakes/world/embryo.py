"""What the specimen looks like: a membrane, and grains inside; both follow where it is pressed."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.settings import SpecimenWorld

Array = npt.NDArray[np.float64]

TAIL_UM = 120.0
"""How the cap's motion fades beyond its edge: the standard deviation of a Gaussian."""

_RIM_UM, _RIM_SIGMA_UM, _RIM_STEP_UM = 8.0, 7.0, 6.0
"""How far inside the surface the membrane's line lies, its thickness, and the distance of the blobs it is made of."""

_GRAIN_SIGMA_UM = (4.0, 6.0)
_JITTER = 0.4
_BRIGHT_SHARE = 0.3


class Embryo:
    """Grains and membrane in a plane through the contact point; places are (along, across) from it, µm.

    Args:
        random: of grains and contrast.
    """

    def __init__(self, settings: SpecimenWorld, random: np.random.Generator) -> None:
        self.radius_um = 0.5 * settings.diameter_um
        self._cap_um = settings.cap_um
        contrast = float(random.uniform(*settings.contrast_levels))
        self._grains = self._draw_grains(settings.grain_distance_um, random)
        number = len(self._grains)
        self._grain_sigmas_um = random.uniform(*_GRAIN_SIGMA_UM, size=number)
        darkness = np.where(random.random(number) < _BRIGHT_SHARE, -1.0, 1.0)
        self._grain_depths = contrast * darkness * random.uniform(0.5, 1.0, size=number)
        self._rim_depth = contrast
        line_um = self.radius_um - _RIM_UM
        turns = np.linspace(0.0, 2.0 * math.pi, math.ceil(2.0 * math.pi * line_um / _RIM_STEP_UM), endpoint=False)
        self._rim = np.column_stack([self.radius_um - line_um * np.cos(turns), line_um * np.sin(turns)])

    def _draw_grains(self, distance_um: float, random: np.random.Generator) -> Array:
        places = np.arange(-self.radius_um, self.radius_um, distance_um)
        along, across = (part.ravel() for part in np.meshgrid(places, places))
        grains = np.column_stack([along, across])
        grains += random.uniform(-_JITTER, _JITTER, size=grains.shape) * distance_um
        inside = np.hypot(grains[:, 0], grains[:, 1]) < self.radius_um - _RIM_UM - 2.0 * _RIM_SIGMA_UM
        return np.asarray(grains[inside] + np.array([self.radius_um, 0.0]))

    def grains(self, deformation_um: float, slip_um: float, across_um: float) -> tuple[Array, Array, Array]:
        """Places (N×2), radii (µm) and depths (grey levels) of all grains; see `membrane`."""
        places = self._moved(self._grains, deformation_um, slip_um, across_um)
        return places, self._grain_sigmas_um, self._grain_depths

    def membrane(
        self, deformation_um: float, slip_um: float, across_um: float, *, px_per_um: float, blur_px: float
    ) -> tuple[Array, Array, Array]:
        """Places (N×2), radii (µm) and depths (grey levels) of blobs which together are a line of even darkness.

        Args:
            deformation_um: how far the contact point has moved inwards.
            slip_um: how much of that with the whole specimen.
            across_um: where on the surface it is touched.
            px_per_um: of the picture.
            blur_px: of the picture.
        """
        places = self._moved(self._rim, deformation_um, slip_um, across_um)
        sigma_px = math.hypot(_RIM_SIGMA_UM * px_per_um, blur_px)
        depth = self._rim_depth * _RIM_STEP_UM * px_per_um / (sigma_px * math.sqrt(2.0 * math.pi))
        return places, np.full(len(places), _RIM_SIGMA_UM), np.full(len(places), depth)

    def _moved(self, places: Array, deformation_um: float, slip_um: float, across_um: float) -> Array:
        hollow_um = self.radius_um - math.sqrt(max(self.radius_um**2 - across_um**2, 0.0))
        distance_um = np.hypot(places[:, 0] - hollow_um, places[:, 1] - across_um)
        beyond = np.maximum(distance_um - self._cap_um, 0.0) / TAIL_UM
        moved = places.copy()
        moved[:, 0] += slip_um + (deformation_um - slip_um) * np.exp(-0.5 * beyond * beyond)
        return moved
