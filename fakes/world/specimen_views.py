"""The specimen, the probe and the holder as cameras see them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.approach import Place
from microdrivers.fakes.world.painting import Overlay, Rod
from microdrivers.fakes.world.specimen import Specimen

Array = npt.NDArray[np.float64]
Project = Callable[[Array, int], Array]
"""Image coordinates (N×2, px from the principal point) of places in the rig's frame (N×3, µm) at an instant."""

_PROBE_WIDTH_UM, _HOLDER_WIDTH_UM = 60.0, 150.0
_PROBE_DEPTH, _HOLDER_DEPTH = 45.0, 45.0
_MARKS = 150
_MARKED_UM = 700.0
_MARK_SIGMA_UM, _MARK_DEPTH = 5.0, 35.0
_FAR_UM = 200.0


class SpecimenView:
    """What one camera sees of specimen and tools.

    Args:
        project: see `Project`.
        blur_px: of the camera.
        upright: seen from the side, with the outline alone, instead of from above.
        seed: of the marks on the probe.
    """

    def __init__(
        self, specimen: Specimen, project: Project, *, blur_px: float, upright: bool = False, seed: int
    ) -> None:
        self._specimen = specimen
        self._project = project
        self._blur_px = blur_px
        self._upright = upright
        random = np.random.default_rng((seed, 29))
        half = 0.5 * _PROBE_WIDTH_UM - _MARK_SIGMA_UM
        behind = random.uniform(_MARK_SIGMA_UM, _MARKED_UM, size=_MARKS)
        self._marks = np.column_stack([-behind, random.uniform(-half, half, size=_MARKS)])
        self._mark_depths = _MARK_DEPTH * np.where(random.random(_MARKS) < 0.5, -1.0, 1.0)

    def overlay(self, t_ns: int, exposure_ns: int) -> Overlay:
        """What is laid over the picture of an exposure centred at `t_ns`, px from the principal point."""
        own = self._specimen
        touch = own.touch_at(t_ns)
        tip = own.tip_at(t_ns, touch)
        before, after = (own.tip_at(t_ns + half_ns, touch) for half_ns in (-exposure_ns // 2, exposure_ns // 2))
        rods, scale = self._rods(t_ns, tip, abs(after.along_um - before.along_um))
        across_um, other_um = (tip.up_um, tip.aside_um) if self._upright else (tip.aside_um, tip.up_um)
        pressed = (touch.deformation_um, touch.slip_um, across_um)
        parts = [
            own.embryo.membrane(*pressed, px_per_um=scale, blur_px=self._blur_px),
            (self._marks + np.array([tip.along_um, across_um]), np.full(_MARKS, _MARK_SIGMA_UM), self._mark_depths),
        ]
        if not self._upright:
            parts.append(own.embryo.grains(*pressed))
        places, sigmas_um, depths = (np.concatenate(same) for same in zip(*parts, strict=True))
        other = np.zeros(len(places))
        other[len(parts[0][0]) :][:_MARKS] = other_um
        across = (other, places[:, 1]) if self._upright else (places[:, 1], other)
        image = self._project(own.in_rig(np.column_stack([places[:, 0], *across]), t_ns), t_ns)
        return Overlay(np.column_stack([image, scale * sigmas_um, depths]), rods)

    def _rods(self, t_ns: int, tip: Place, moved_um: float) -> tuple[tuple[Rod, ...], float]:
        """Probe and holder, and the picture's scale there, px/µm."""
        own = self._specimen
        surface = Place(0.0, 0.0, 0.0)
        seen = np.array([surface, surface._replace(along_um=1.0), tip, tip._replace(along_um=tip.along_um - _FAR_UM)])
        ends_um = own.in_rig(seen, t_ns)
        holder_um = own.holder_tip_um(t_ns)
        if holder_um is not None:
            ends_um = np.vstack([ends_um, holder_um, holder_um + _FAR_UM * own.probe.direction])
        ends = self._project(ends_um, t_ns)
        scale = math.hypot(*(ends[1] - ends[0]))
        rods = [_rod(ends[2], ends[3], 0.5 * scale * _PROBE_WIDTH_UM, _PROBE_DEPTH)._replace(smear_px=scale * moved_um)]
        if holder_um is not None:
            rods.append(_rod(ends[4], ends[5], 0.5 * scale * _HOLDER_WIDTH_UM, _HOLDER_DEPTH))
        return tuple(rods), scale


def _rod(end: Array, further: Array, half_width_px: float, depth: float) -> Rod:
    along = (further - end) / math.hypot(*(further - end))
    return Rod((float(end[0]), float(end[1])), (float(along[0]), float(along[1])), half_width_px, depth)
