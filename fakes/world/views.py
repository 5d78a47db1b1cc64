"""What each camera of a rig sees of the world."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.optics import Microscope
from microdrivers.fakes.world.painting import Overlay
from microdrivers.fakes.world.scene import Image, Look, Renderer
from microdrivers.fakes.world.specimen import Specimen
from microdrivers.fakes.world.specimen_views import SpecimenView

Array = npt.NDArray[np.float64]

_COARSE_SHARE_OF_SCALE = 0.2
_LATERAL_PX_PER_UM = 0.2
_TIP_UM = (60.0, 2000.0)
"""Width of a tool's end, and its length, which leaves the picture at the top."""

_NO_BLOBS = np.empty((0, 4))


@dataclass(frozen=True)
class View:
    """One camera's view.

    Attributes:
        look: grey levels and blur.
        corners_px: of the one quadrilateral in view at an instant, 4×2 px from the principal point.
        blobs_px: of an instant and the principal point; rows of u, v, radius (px) and depth (grey levels).
        overlay: what lies over all that, of an instant and an exposure, px from the principal point; None if nothing.
        noise_seed: of the pixel noise, together with the frame's number.
        publish_truth: of an instant and the frame's number.
    """

    look: Look
    corners_px: Callable[[int], Array]
    noise_seed: tuple[int, ...]
    blobs_px: Callable[[int, Array], Array] = lambda _t_ns, _origin: _NO_BLOBS
    publish_truth: Callable[[int, int], None] = lambda _t_ns, _frame_id: None
    overlay: Callable[[int, int], Overlay | None] = lambda _t_ns, _exposure_ns: None

    def render(
        self,
        t_ns: int,
        *,
        exposure_ns: int,
        renderer: Renderer,
        principal_point_px: tuple[float, float],
        frame_id: int,
    ) -> Image:
        """The image of an exposure centred at `t_ns`."""
        origin = np.asarray(principal_point_px)
        corners = self.corners_px(t_ns)
        travel = self.corners_px(t_ns + exposure_ns // 2) - self.corners_px(t_ns - exposure_ns // 2)
        overlay = self.overlay(t_ns, exposure_ns)
        return renderer.render(
            corners + origin,
            travel,
            self.blobs_px(t_ns, origin),
            random=np.random.default_rng((*self.noise_seed, frame_id)),
            overlay=None if overlay is None else overlay.shifted(origin),
        )


def coarse_optics(name: str, fine: Microscope, *, seed: int) -> Microscope:
    """Of a camera from above with a fixed, low magnification and a rotation of its own; project with zoom 1."""
    random = np.random.default_rng((seed, 13, zlib.crc32(name.encode())))
    return fine._replace(
        scale_per_zoom_px_per_um=_COARSE_SHARE_OF_SCALE * fine.scale_per_zoom_px_per_um,
        angle_deg=float(random.uniform(-180.0, 180.0)),
        boresight_px=(0.0, 0.0),
    )


def coarse_noise_seed(name: str, *, seed: int) -> tuple[int, ...]:
    """Of the pixel noise of such a camera."""
    return seed, 13, zlib.crc32(name.encode())


def lateral_view(
    name: str, look: Look, stages: Mapping[str, Mapping[str, Axis]], specimen: Specimen | None, *, seed: int
) -> View:
    """From the side, the rig's x to the right and its z up: the specimen's outline and its tools.

    Without a specimen it is the end of the first fine stage's tool, which comes from above; empty without a stage.
    """
    noise_seed = (seed, 17, zlib.crc32(name.encode()))
    if specimen is not None:

        def project(places_um: Array, _t_ns: int) -> Array:
            return np.asarray(_LATERAL_PX_PER_UM * (places_um - specimen.surface_um)[:, [0, 2]] * np.array([1.0, -1.0]))

        seen = SpecimenView(specimen, project, blur_px=look.blur_px, upright=True, seed=seed)
        return View(look, nothing_px, noise_seed, overlay=seen.overlay)
    axes = next(iter(stages.values()), None)

    def corners_px(t_ns: int) -> Array:
        if axes is None:
            return nothing_px(t_ns)
        x_um, z_um = axes["x"].position_at(t_ns), axes["z"].position_at(t_ns)
        half, length = 0.5 * _TIP_UM[0], _TIP_UM[1]
        side_um = np.array([[-half, 0.0], [half, 0.0], [half, length], [-half, length]]) + np.array([x_um, z_um])
        return np.asarray(_LATERAL_PX_PER_UM * side_um * np.array([1.0, -1.0]), dtype=np.float64)

    return View(look._replace(contrast_levels=-abs(look.contrast_levels)), corners_px, noise_seed)


def nothing_px(_t_ns: int) -> Array:
    """Corners of a quadrilateral that no picture shows."""
    return np.asarray(1e6 + np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
