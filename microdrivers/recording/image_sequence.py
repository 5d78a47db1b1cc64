"""A recorded image sequence: a folder with `frames.csv` (file, time_s, x_um, y_um, zoom) and its images.

Further columns and lines that begin with `#` are allowed. Playing it publishes on the same topics, with the same
sample types, as a live rig does.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from microdrivers.core.bus import Bus
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import Frame, XYThetaSample, ZoomSample
from microdrivers.core.units import seconds_to_ns

_LARGEST_NUMBER = 1e9
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

    Raises:
        ConfigError: no such folder or file, a missing column, a value that is not a finite number, times that do not
            increase, a named image that does not exist; each with file, line and column.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows = _read_rows(folder)

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
    try:
        return _parse_table(folder)
    except (UnicodeDecodeError, csv.Error, OSError) as error:
        raise ConfigError(
            f"cannot be read as a table: {error}", file=str(folder / "frames.csv"), remedy="save it as CSV in UTF-8"
        ) from error


def _parse_table(folder: Path) -> list[SequenceRow]:
    table = folder / "frames.csv"
    if not folder.is_dir():
        raise ConfigError("there is no such folder", file=str(folder), remedy="check the path")
    if not table.is_file():
        raise ConfigError(
            "an image sequence needs a frames.csv",
            file=str(folder), remedy=f"add frames.csv with the columns {', '.join(COLUMNS)}",
        )  # fmt: skip
    rows: list[SequenceRow] = []
    with table.open(encoding="utf-8-sig", newline="") as stream:
        header: list[str] | None = None
        for number, cells in enumerate(csv.reader(stream), start=1):
            if not cells or cells[0].lstrip().startswith("#"):
                continue
            if header is None:
                header = [cell.strip() for cell in cells]
                _check_header(table, number, header)
                continue
            row = _parse_row(folder, number, header, cells)
            if rows and row.t_ns <= rows[-1].t_ns:
                raise ConfigError(
                    "time does not increase", file=str(table), line=number, column=header.index("time_s") + 1,
                    key="time_s", remedy="sort the rows by time and remove repetitions",
                )  # fmt: skip
            rows.append(row)
    if not rows:
        raise ConfigError("the sequence has no frames", file=str(table), line=1, remedy="add a row for each image")
    return rows


def _check_header(table: Path, line: int, header: list[str]) -> None:
    missing = [column for column in COLUMNS if column not in header]
    if missing:
        raise ConfigError(
            f"column {', '.join(missing)} is missing (found: {', '.join(header)})",
            file=str(table), line=line, column=1, remedy=f"the header must name {', '.join(COLUMNS)}",
        )  # fmt: skip


def _parse_row(folder: Path, line: int, header: list[str], cells: list[str]) -> SequenceRow:
    table = str(folder / "frames.csv")
    if len(cells) < len(header):
        raise ConfigError(
            f"the row has {len(cells)} cells, the header {len(header)}",
            file=table, line=line, column=len(cells), remedy="complete the row",
        )  # fmt: skip
    cell = dict(zip(header, cells, strict=False))
    numbers: dict[str, float] = {}
    for key in COLUMNS[1:]:
        try:
            numbers[key] = float(cell[key])
        except ValueError:
            numbers[key] = math.nan
        if not abs(numbers[key]) < _LARGEST_NUMBER or (key == "zoom" and numbers[key] <= 0):
            above = " above zero" if key == "zoom" else ""
            raise ConfigError(
                f"{cell[key]!r} is not a finite number{above}", file=table, line=line,
                column=header.index(key) + 1, key=key,
                remedy="write a plain number in the unit that the column's name states",
            )  # fmt: skip
    image = folder / cell["file"].strip()
    if not image.is_file():
        raise ConfigError(
            f"there is no image {cell['file']!r}", file=table, line=line, column=header.index("file") + 1, key="file",
            remedy="add the image beside frames.csv, or remove its line",
        )  # fmt: skip
    return SequenceRow(line, image, seconds_to_ns(numbers["time_s"]), numbers["x_um"], numbers["y_um"], numbers["zoom"])


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}×{shape[0]}"
