"""A recorded image sequence: a folder with `frames.csv` (file, time_s, x_um, y_um, zoom) and its images.

Further columns and lines that begin with `#` are allowed; a frame without a pose or zoom (NaN, or an empty cell) is
left out. Playing it publishes on the same topics, with the same sample types, as a live rig does.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from microdrivers.core.bus import Bus
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import Frame, XYThetaSample, ZoomSample
from microdrivers.core.units import seconds_to_ns
from microdrivers.recording.table import Table, TableRow

COLUMNS = ("file", "time_s", "x_um", "y_um", "zoom")
ZOOM_STEPS_PER_UNIT = 10_000
"""A sequence has no motor: positions are given as zoom in these units."""


class SequenceRow(NamedTuple):
    """One line of `frames.csv`."""

    line: int
    file: Path
    t_ns: int
    x_um: float
    y_um: float
    zoom: float


class ImageSequence:
    """A sequence that has been read and checked, images excepted.

    Attributes:
        rows: frames that have a pose and a zoom.
        flaws: how many frames have none, and were left out.

    Raises:
        ConfigError: no such folder or file, a missing column, a value that is not a number, times that do not
            increase, a named image that does not exist, each with file, line and column; no frame with pose and zoom.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        rows = _read_rows(folder)
        self.rows = [row for row in rows if not any(map(math.isnan, (row.x_um, row.y_um, row.zoom)))]
        self.flaws = _lacking(rows)
        if not self.rows:
            raise ConfigError(
                f"no frame has both a pose and a zoom ({'; '.join(self.flaws)})",
                file=str(folder / "frames.csv"),
                remedy="record again with the stage referenced (`microdrivers reference`), stage and zoom included; "
                "an export has no pose where the stage was not referenced",
            )  # fmt: skip

    def __len__(self) -> int:
        return len(self.rows)

    def load(self, row: SequenceRow) -> npt.NDArray[np.uint8 | np.uint16]:
        """Read one image, grey, read-only.

        Raises:
            ConfigError: it is damaged, or of another size than the first one.
        """
        import cv2

        image = cv2.imread(str(row.file), cv2.IMREAD_UNCHANGED) if row.file.stat().st_size else None
        if image is None:
            raise self._error(row, f"{row.file.name} is not a readable image (damaged or truncated)")
        if image.ndim == 3:
            image = cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY)
        if image.dtype not in (np.uint8, np.uint16):
            raise self._error(row, f"{row.file.name} has {image.dtype} pixels; 8 or 16 bit are needed")
        image.flags.writeable = False
        return cast("npt.NDArray[np.uint8 | np.uint16]", image)

    def publish(self, bus: Bus, *, stage: str, zoom: str, camera: str) -> None:
        """Publish pose, zoom and frame of each row, in that order."""
        poses, zooms = bus.topic(stage, XYThetaSample), bus.topic(zoom, ZoomSample)
        frames = bus.topic(camera, Frame)
        shape: tuple[int, ...] | None = None
        previous_zoom = self.rows[0].zoom
        for seq, row in enumerate(self.rows):
            image = self.load(row)
            if shape is not None and image.shape != shape:
                raise self._error(row, f"{row.file.name} is {_size(image.shape)} px, the first {_size(shape)}")
            shape = image.shape
            poses.publish(
                XYThetaSample(
                    t_ns=row.t_ns, device=stage, t_source="recorded", seq=seq, x_um=row.x_um, y_um=row.y_um,
                    theta_deg=0.0, moving=False, on_target=True, referenced=True,
                )
            )  # fmt: skip
            moving = not math.isclose(row.zoom, previous_zoom, rel_tol=1e-6)
            previous_zoom = row.zoom
            zooms.publish(
                ZoomSample(
                    t_ns=row.t_ns, device=zoom, t_source="recorded", seq=seq, zoom=row.zoom,
                    position_steps=round(row.zoom * ZOOM_STEPS_PER_UNIT), moving=moving, on_target=not moving,
                    referenced=True,
                )
            )  # fmt: skip
            height, width = shape
            frames.publish(
                Frame(
                    t_ns=row.t_ns, device=camera, t_source="recorded", seq=seq, image=image, exposure_ms=0.0,
                    frame_id=seq, bit_depth=8 * image.itemsize,
                    principal_point_px=((width - 1) / 2, (height - 1) / 2),
                )
            )  # fmt: skip

    def _error(self, row: SequenceRow, what: str) -> ConfigError:
        return ConfigError(
            what, file=str(self.folder / "frames.csv"), line=row.line, column=1, key="file",
            remedy="replace the image, or remove its line",
        )  # fmt: skip


def _read_rows(folder: Path) -> list[SequenceRow]:
    file = folder / "frames.csv"
    if not folder.is_dir():
        raise ConfigError("there is no such folder", file=str(folder), remedy="check the path")
    if not file.is_file():
        raise ConfigError(
            "an image sequence needs a frames.csv",
            file=str(folder), remedy=f"add frames.csv with the columns {', '.join(COLUMNS)}",
        )  # fmt: skip
    table = Table(file, columns=COLUMNS, numeric=COLUMNS[1:], positive=("zoom",), may_be_nan=COLUMNS[2:])
    return [_sequence_row(table, row) for row in table.rows]


def _sequence_row(table: Table, row: TableRow) -> SequenceRow:
    image = table.file.parent / row.cells["file"].strip()
    if not image.is_file():
        raise table.error(
            row, "file", f"there is no image {row.cells['file']!r}",
            remedy="add the image beside frames.csv, or remove its line",
        )  # fmt: skip
    numbers = row.numbers
    return SequenceRow(
        row.line, image, seconds_to_ns(numbers["time_s"]), numbers["x_um"], numbers["y_um"], numbers["zoom"]
    )


def _lacking(rows: list[SequenceRow]) -> tuple[str, ...]:
    """What frames lack, and how many of them."""
    lacking = {
        "a pose (x_um, y_um)": sum(math.isnan(row.x_um) or math.isnan(row.y_um) for row in rows),
        "a zoom": sum(math.isnan(row.zoom) for row in rows),
    }
    return tuple(f"frames without {what}: {number} of {len(rows)}" for what, number in lacking.items() if number)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}×{shape[0]}"
