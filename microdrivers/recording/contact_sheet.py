"""A contact sheet: thumbnails of a recording's frames, evenly spread, one block of rows a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_S
from microdrivers.recording.channels import literal
from microdrivers.recording.export.pictures import eight_bit
from microdrivers.recording.output import refuse_existing, whole_file
from microdrivers.recording.reader import Recording
from microdrivers.recording.views import start_ns

_THUMBNAIL_PX = (240, 180)
_LINE_PX = 18
_GAP_PX = 6
_INK = 40
_PAPER = 255

Image = npt.NDArray[np.uint8]


def write_contact_sheet(recording: Recording, file: Path, *, frames: int = 12, columns: int = 4) -> int:
    """Write a PNG that shows up to `frames` frames of each camera, in `columns` columns, with the time of each.

    Returns:
        how many frames it shows.

    Raises:
        UnsupportedError: the recording has no frames. ConfigError: the file exists, cannot be written, or is no .png.
    """
    import cv2

    refuse_existing(file, "a contact sheet")
    if file.suffix.lower() != ".png":
        raise ConfigError("the name of a contact sheet must end in .png", file=str(file), remedy="rename it")

    cameras = {name: found for name, found in recording.topics.items() if found.sample_type is Frame and found.count}
    if not cameras:
        raise UnsupportedError(
            f"{recording.file} has no frames to show", remedy="leave out --contact-sheet, or record a camera's topic"
        )
    begin = start_ns(recording)
    blocks: list[Image] = []
    shown = 0
    for name, found in cameras.items():
        wanted = {round(i) for i in np.linspace(0, found.count - 1, min(frames, found.count))}
        thumbnails = [
            _thumbnail(frame, begin)
            for index, (_, frame) in enumerate(recording.samples([literal(name)]))
            if index in wanted and isinstance(frame, Frame)
        ]
        shown += len(thumbnails)
        blocks.append(_block(f"{name}: {found.count} frames, {found.usual_rate_hz:.3g} Hz", thumbnails, columns))
    done, data = cv2.imencode(".png", np.vstack(blocks))
    if not done:
        raise UnsupportedError(f"{shown} frames could not be made one image", remedy="leave out --contact-sheet")
    try:
        with whole_file(file) as part:
            part.write_bytes(data.tobytes())
    except OSError as error:
        raise ConfigError(
            f"the contact sheet cannot be written: {error.strerror}", file=str(file), remedy="choose another new file"
        ) from error
    return shown


def _thumbnail(frame: Frame, begin_ns: int) -> Image:
    import cv2

    image = eight_bit(frame)
    width, height = _THUMBNAIL_PX
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    tile: Image = np.full((height + _LINE_PX, width), _PAPER, dtype=np.uint8)
    tile[: size[1], : size[0]] = small
    _write(tile, f"{(frame.t_ns - begin_ns) / NS_PER_S:.3f} s  #{frame.seq}", height + _LINE_PX - 5)
    return tile


def _block(title: str, tiles: list[Image], columns: int) -> Image:
    width, height = _THUMBNAIL_PX[0] + _GAP_PX, _THUMBNAIL_PX[1] + _LINE_PX + _GAP_PX
    rows = -(-len(tiles) // columns)
    block: Image = np.full((rows * height + _LINE_PX + _GAP_PX, columns * width), _PAPER, dtype=np.uint8)
    _write(block, title, _LINE_PX)
    for index, tile in enumerate(tiles):
        top, left = (index // columns) * height + _LINE_PX + _GAP_PX, (index % columns) * width
        block[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return block


def _write(image: Any, text: str, baseline: int) -> None:
    import cv2

    # OpenCV's font has no other letters.
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(image, plain, (2, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
