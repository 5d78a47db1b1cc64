"""A recorded indentation: CSV with `time_s`, `indentation_um`, `force_uN`; further columns and `#` lines allowed.

Playing it publishes on the same topics, with the same sample types, as a live rig does.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from microdrivers.core.bus import Bus
from microdrivers.core.contact_samples import DeformationSample, IndentationSample
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.recording.table import Table

COLUMNS = ("time_s", "indentation_um", "force_uN")

INVALID_READING = frozenset({"NOT_MEASURED"})


class IndentationTable:
    """A recorded indentation that has been read and checked.

    An empty cell, or `nan`, in `force_uN` or `indentation_um` is a reading that is not valid, or a lost contact point.

    Raises:
        ConfigError: no such file, a missing column, a value that is no number, times that do not increase; each with
            file, line and column.
    """

    def __init__(self, file: Path) -> None:
        if not file.is_file():
            raise ConfigError("there is no such file", file=str(file), remedy="check the path")
        self.file = file
        self._rows = Table(file, columns=COLUMNS, numeric=COLUMNS, may_be_nan=COLUMNS[1:]).rows

    def column(self, name: str) -> list[float]:
        """Values of `time_s`, `indentation_um` or `force_uN`; NaN where nothing was measured."""
        return [row.numbers[name] for row in self._rows]

    def __len__(self) -> int:
        return len(self._rows)

    def publish(self, bus: Bus, *, sensor: str, deformation: str) -> None:
        """Publish force and deformation of each row, in that order."""
        forces, deformations = bus.topic(sensor, ForceSample), bus.topic(deformation, DeformationSample)
        for seq, row in enumerate(self._rows):
            t_ns = seconds_to_ns(row.numbers["time_s"])
            force_uN, depth_um = row.numbers["force_uN"], row.numbers["indentation_um"]
            forces.publish(
                ForceSample(
                    t_ns=t_ns, device=sensor, t_source="recorded", seq=seq, force_uN=force_uN, raw_uN=force_uN,
                    flags=INVALID_READING if math.isnan(force_uN) else frozenset(),
                )
            )  # fmt: skip
            deformations.publish(
                DeformationSample(
                    t_ns=t_ns, device=deformation, t_source="recorded", seq=seq, deformation_um=depth_um,
                    sigma_um=math.nan, tip_um=math.nan, tip_sigma_um=math.nan, u_px=math.nan, v_px=math.nan,
                    found=not math.isnan(depth_um), frame_seq=seq, exposure_ms=0.0,
                )
            )  # fmt: skip


def write_indentation_table(file: Path, samples: Sequence[IndentationSample]) -> None:
    """Write matched samples as such a table; time counts from the first of them.

    Raises:
        OSError: the file cannot be written.
    """
    start_ns = samples[0].t_ns if samples else 0
    with file.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow((*COLUMNS, "indentation_sigma_um", "force_sigma_uN"))
        for sample in samples:
            table.writerow(
                (
                    f"{(sample.t_ns - start_ns) / NS_PER_S:.9f}",
                    repr(sample.deformation_um),
                    repr(sample.force_uN),
                    f"{sample.deformation_sigma_um:.6g}",
                    f"{sample.force_sigma_uN:.6g}",
                )
            )
