"""`microdrivers snap`."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from microdrivers.cli.rig_options import RigChoice, rig_options

if TYPE_CHECKING:
    from microdrivers.core.samples import Frame
    from microdrivers.devices.camera import Camera
    from microdrivers.rig import Rig

_FORMATS = (".png", ".tif", ".tiff")
_RATE_SHARE = 0.99
"""An exposure that fills more of the frame period than this gets a lower rate."""


@click.command(short_help="Take one fresh frame and write it to a file.")
@rig_options
@click.argument("camera", required=False)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="FILE.png or FILE.tif to write.")
@click.option("--exposure-ms", type=float, help="Exposure time; default: the rig file's.")
@click.option("--force", is_flag=True, help="Overwrite FILE.")
def snap(choice: RigChoice, camera: str | None, out: Path, exposure_ms: float | None, force: bool) -> None:
    """Take one frame with CAMERA of the rig file RIG, exposed after the command, and write it with its bit depth.

    CAMERA may be left out if the rig has a microscope or one camera only. Only the camera is opened. An exposure that
    does not fit the rig file's frame rate lowers the rate.

    \b
    Examples:
      microdrivers snap lab.yaml --out frame.png
      microdrivers snap lab.yaml camera_fine --out frame.tif --exposure-ms 5
      microdrivers snap lab.yaml --out frame.png --force --fake
    """
    _check_file(out, force)
    with closing(choice.build()) as rig:
        device = _find(rig, camera)
        device.open()
        if exposure_ms is not None:
            _expose(device, exposure_ms)
        frame = device.grab(timeout_s=2.0 + 3.0 / device.settings.rate_hz)
        _write(frame, out, force)
        click.echo("\n".join(_describe(frame, out)))


def _check_file(out: Path, force: bool) -> None:
    from microdrivers.core.errors import ConfigError

    if out.suffix.lower() not in _FORMATS:
        raise ConfigError(
            f"cannot write {out.suffix or 'a name without an ending'}", file=str(out),
            remedy=f"end the name in {', '.join(_FORMATS)}: these keep every bit",
        )  # fmt: skip
    if out.exists() and not force:
        raise ConfigError("the file exists", file=str(out), remedy="choose another name, or overwrite it with --force")
    if not out.parent.is_dir():
        raise ConfigError("there is no such folder", file=str(out.parent), remedy="make it first")


def _find(rig: Rig, name: str | None) -> Camera:
    from microdrivers.core.errors import UnsupportedError
    from microdrivers.devices.camera import Camera

    if name is None and rig.file.microscope is not None:
        name = rig.file.microscope.camera
    cameras = [known for known, device in rig.devices.items() if isinstance(device, Camera)]
    if name is None:
        if len(cameras) != 1:
            raise UnsupportedError(
                f"the rig has {len(cameras)} cameras", remedy=f"name one: {', '.join(cameras) or 'none'}"
            )
        name = cameras[0]
    return rig.device(name, Camera)


def _expose(camera: Camera, exposure_ms: float) -> None:
    longest_ms = 1000.0 * _RATE_SHARE / camera.settings.rate_hz
    if exposure_ms > longest_ms:
        camera.configure(exposure_ms=exposure_ms, rate_hz=1000.0 * _RATE_SHARE / exposure_ms)
    else:
        camera.configure(exposure_ms=exposure_ms)


def _write(frame: Frame, out: Path, force: bool) -> None:
    import cv2

    from microdrivers.core.errors import ConfigError

    _, encoded = cv2.imencode(out.suffix.lower(), frame.image)
    try:
        with out.open("wb" if force else "xb") as file:
            file.write(encoded.tobytes())
    except OSError as error:
        remedy = "check the folder, its permissions and the space left"
        raise ConfigError(f"cannot be written: {error}", file=str(out), remedy=remedy) from error


def _describe(frame: Frame, out: Path) -> list[str]:
    from microdrivers.core.units import NS_PER_MS, NS_PER_S
    from microdrivers.routines.camera_check import full_scale, saturated_share

    height, width = frame.image.shape[:2]
    share = saturated_share(frame)
    known = "the camera's own stamp" if frame.t_source == "device" else f"known by {frame.t_source} only"
    when = f"{frame.t_ns / NS_PER_S:.6f} s on the rig's clock, ±{frame.dt_ns / NS_PER_MS:.3g} ms"
    saturation = f"{100 * share:.3g} % of the pixels at {full_scale(frame)}" if share else "no pixel"
    return [
        f"{out}: {width}×{height} px, {frame.bit_depth} bit, frame {frame.frame_id} of {frame.device}",
        f"  mid-exposure  {when} ({known})",
        f"  exposure      {frame.exposure_ms:g} ms",
        f"  saturated     {saturation}",
    ]
