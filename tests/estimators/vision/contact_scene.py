"""Analytic images of a probe that comes up to a specimen and presses on it, for the vision tests.

Nothing here uses the estimators' or the simulated rig's code. The specimen is a disc with a texture of plane waves;
what lies within `rigid_um` of the contact point moves as one with it, what lies farther away moves less. Each pixel
is evaluated at the place of the undeformed specimen that it shows, so that no image is resampled.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.samples import Frame

Array = npt.NDArray[np.float64]

_WAVES = 20


def normal_cdf(x: Array) -> Array:
    """Cumulative normal distribution by Abramowitz & Stegun 7.1.26, absolute error below 1e-6."""
    result = np.asarray(x > 0.0, dtype=np.float64)
    near = np.abs(x) < 5.0
    inside = x[near]
    z = np.abs(inside) / np.sqrt(2.0)
    k = 1.0 / (1.0 + 0.3275911 * z)
    series = k * (0.254829592 + k * (-0.284496736 + k * (1.421413741 + k * (-1.453152027 + k * 1.061405429))))
    erf = 1.0 - series * np.exp(-z * z)
    result[near] = 0.5 * (1.0 + np.where(inside < 0, -erf, erf))
    return result


class Look(NamedTuple):
    """What is in view. Lengths of the scene in µm, of the image in px, grey levels of 255.

    `angle_deg` is the direction of probing in the image, from +u towards +v. `texture_levels` is the standard
    deviation of the specimen's texture, `rod_texture_levels` of the probe's. `shear_um` is the length over which the
    displacement dies away beyond `rigid_um`.
    """

    angle_deg: float = 180.0
    scale_px_per_um: float = 0.4
    contact_px: tuple[float, float] = (150.0, 120.0)
    shape: tuple[int, int] = (240, 320)
    blur_px: float = 1.2
    background: float = 170.0
    specimen: float = 130.0
    rod: float = 50.0
    rim_levels: float = 35.0
    texture_levels: float = 14.0
    rod_texture_levels: float = 0.0
    radius_um: float = 650.0
    rod_half_width_um: float = 30.0
    rod_tilt: float = 0.0
    rigid_um: float = 120.0
    shear_um: float = 200.0
    specks: tuple[tuple[float, float, float, float], ...] = ()


class ContactScene:
    """Renders frames of one specimen and one probe.

    Args:
        seed: of the texture and of the noise.
        noise: standard deviation of the noise, grey levels.
        look: what is in view, by the names of `Look`.
    """

    def __init__(self, seed: int, *, noise: float = 2.0, **look: Any) -> None:
        self.look = Look(**look)
        self._rng = np.random.default_rng(seed)
        self._noise = noise
        angle = np.deg2rad(self.look.angle_deg)
        self.direction = np.array([np.cos(angle), np.sin(angle)])
        v, u = np.mgrid[0 : self.look.shape[0], 0 : self.look.shape[1]].astype(np.float64)
        du, dv = u - self.look.contact_px[0], v - self.look.contact_px[1]
        self._along = (du * self.direction[0] + dv * self.direction[1]) / self.look.scale_px_per_um
        self._across = (-du * self.direction[1] + dv * self.direction[0]) / self.look.scale_px_per_um
        self._specimen_waves = self._waves()
        self._rod_waves = self._waves()
        self._dust = np.zeros(self.look.shape)
        for u0, v0, radius, level in self.look.specks:
            self._dust += level * np.exp(-0.5 * ((u - u0) ** 2 + (v - v0) ** 2) / radius**2)
        self._seq = -1

    def grey(self, *, tip_um: float, deformation_um: float = 0.0) -> Array:
        """Grey levels without noise: the tip at `tip_um` from the undeformed surface, the contact point displaced."""
        look, blur_um = self.look, self.look.blur_px / self.look.scale_px_per_um
        along, across = self._material(deformation_um), self._across
        depth = look.radius_um - np.hypot(along - look.radius_um, across)
        inside = normal_cdf(depth / blur_um)
        body = np.full(look.shape, look.specimen)
        near = (depth > -4.0 * blur_um) & (along**2 + across**2 < 140.0**2)
        body[near] += look.texture_levels * self._texture(self._specimen_waves, along[near], across[near])
        rim = look.rim_levels * np.exp(-0.5 * (depth - 6.0) ** 2 / (5.0**2 + blur_um**2))
        image = look.background + inside * (body - look.background) - rim + self._dust
        half = look.rod_half_width_um + look.rod_tilt * np.maximum(tip_um - self._along, 0.0)
        cover = normal_cdf((tip_um - self._along) / blur_um) * (
            normal_cdf((across + half) / blur_um) - normal_cdf((across - half) / blur_um)
        )
        rod = np.full(look.shape, look.rod)
        if look.rod_texture_levels:
            on_rod = cover > 1e-6
            grain = self._texture(self._rod_waves, self._along[on_rod] - tip_um, across[on_rod])
            rod[on_rod] += look.rod_texture_levels * grain
        return np.asarray(image + cover * (rod - image))

    def digitise(self, grey: Array, *, gain: float = 1.0, bias: float = 0.0) -> Frame:
        """A frame of `grey` under another light, with noise."""
        noisy = bias + gain * grey + self._noise * self._rng.standard_normal(grey.shape)
        return self.frame(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))

    def show(self, *, tip_um: float, deformation_um: float = 0.0, gain: float = 1.0, bias: float = 0.0) -> Frame:
        """The frame of a state."""
        return self.digitise(self.grey(tip_um=tip_um, deformation_um=deformation_um), gain=gain, bias=bias)

    def press(self, tip_um: float) -> Frame:
        """The frame of a tip that pushes the surface before it, from `tip_um` = 0 on."""
        return self.show(tip_um=tip_um, deformation_um=max(0.0, tip_um))

    def approach(self, start_um: float, end_um: float, count: int) -> tuple[list[Frame], list[float]]:
        """Frames of a tip that comes nearer in equal steps, and its travel since the first of them."""
        places = np.linspace(start_um, end_um, count)
        return [self.press(float(place)) for place in places], (places - start_um).tolist()

    def frame(self, image: npt.NDArray[Any]) -> Frame:
        """A frame at 30 Hz around `image`, read-only as cameras publish it."""
        self._seq += 1
        image = image.view()
        image.flags.writeable = False
        return Frame(
            t_ns=1_000_000_000 + self._seq * 33_333_333,
            dt_ns=5_000,
            device="camera",
            seq=self._seq,
            image=image,
            exposure_ms=5.0,
            frame_id=self._seq,
            principal_point_px=((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2),
        )

    def _material(self, deformation_um: float) -> Array:
        """Where along the direction of probing each pixel's matter lay before the specimen was deformed, µm."""
        along = self._along - deformation_um
        if deformation_um == 0.0:
            return along
        across_squared = self._across**2
        for _ in range(6):
            beyond = np.maximum(np.sqrt(along * along + across_squared) - self.look.rigid_um, 0.0)
            beyond /= self.look.shear_um
            along = self._along - deformation_um * np.exp(-beyond * beyond)
        return along

    def _waves(self) -> Array:
        """Rows of kx, ky (rad/µm), phase and amplitude: wavelengths 6 to 40 px, blurred as the optics do."""
        wavelength = np.exp(self._rng.uniform(np.log(6.0), np.log(40.0), _WAVES))
        direction, phase = self._rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES))
        wavenumber = 2.0 * np.pi / wavelength
        sharpness = np.exp(-0.5 * (wavenumber * self.look.blur_px) ** 2)
        k = wavenumber * self.look.scale_px_per_um
        return np.stack([k * np.cos(direction), k * np.sin(direction), phase, np.sqrt(2.0 / _WAVES) * sharpness])

    @staticmethod
    def _texture(waves: Array, along: Array, across: Array) -> Array:
        # Single precision is good to 1e-5 levels here, and much faster.
        x, y = along.astype(np.float32), across.astype(np.float32)
        total = np.zeros(along.shape, dtype=np.float32)
        for kx, ky, phase, amplitude in waves.T.astype(np.float32):
            total += amplitude * np.cos(kx * x + ky * y + phase)
        return total.astype(np.float64)
