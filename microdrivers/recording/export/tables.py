"""Topics as tables: CSV and Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from microdrivers.core.samples import Sample
from microdrivers.recording.columns import columns_of, describe
from microdrivers.recording.views import Array, arrays_of, flattened, optional_module, unit_of_column

BATCH_SAMPLES = 16_384
_PANDAS_ATTRIBUTES = "PANDAS_ATTRS"
"""Under this key of a file's metadata, pandas keeps a DataFrame's `attrs`."""


class CsvTopic:
    """Writes one topic: a header, then one line a sample.

    Floats keep their bits, true is 1; flags, and tuples of any length, are words or numbers with spaces between them.
    """

    batch = BATCH_SAMPLES
    remarks: Sequence[str] = ()

    def __init__(self, file: Path, sample_type: type[Sample], *, start_ns: int) -> None:
        self._stream = file.open("x", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream, lineterminator="\n")
        self._type = sample_type
        self._start_ns = start_ns
        self._writer.writerow(_columns([], sample_type, start_ns))

    def write(self, samples: list[Sample]) -> None:
        """Append samples."""
        columns = _columns(samples, self._type, self._start_ns).values()
        self._writer.writerows(zip(*map(_cells, columns), strict=True))

    def close(self) -> None:
        """Complete the file."""
        self._stream.close()

    def verify(self) -> None:
        """`write` and `close` have told."""


class ParquetTopic:
    """Writes one topic; fields carry `units` and `description` as metadata, pandas' `attrs` those of `data_frame`.

    Raises:
        UnsupportedError: pyarrow is not installed.
    """

    batch = BATCH_SAMPLES
    remarks: Sequence[str] = ()

    def __init__(self, file: Path, sample_type: type[Sample], *, topic: str, start_ns: int) -> None:
        self._arrow = optional_module("pyarrow")
        parquet = optional_module("pyarrow.parquet")
        self._type = sample_type
        self._start_ns = start_ns
        about = {"topic": topic, "sample_type": sample_type.__name__, "description": describe(sample_type)}
        fields = self._fields()
        units = {field.name: unit_of_column(field.name) for field in fields}
        attrs = json.dumps(about | {"start_ns": start_ns, "units": units})
        self._schema = self._arrow.schema(
            fields, metadata=about | {"start_ns": str(start_ns), _PANDAS_ATTRIBUTES: attrs}
        )
        self._writer = parquet.ParquetWriter(str(file), self._schema)

    def _fields(self) -> list[Any]:
        arrow = self._arrow
        kinds = {
            "double": arrow.float64(), "doubles": arrow.float64(), "int": arrow.int64(), "ints": arrow.int64(),
            "bool": arrow.bool_(),
        }  # fmt: skip
        fields = [arrow.field("time_s", arrow.float64(), metadata={"units": "s"})]
        for column in columns_of(self._type):
            kind = kinds.get(column.kind, arrow.string())
            kind = arrow.list_(kind) if column.shape == "any" else kind
            about = {"units": column.unit, "description": column.description}
            names = [f"{column.name}_{n}" for n in range(column.length)] if column.shape == "fixed" else [column.name]
            fields += [arrow.field(name, kind, metadata=about) for name in names]
        return fields

    def write(self, samples: list[Sample]) -> None:
        """Append samples, as one row group."""
        columns = _columns(samples, self._type, self._start_ns)
        arrays = [
            self._arrow.array(list(array) if array.dtype == object else array, type=field.type)
            for array, field in zip(columns.values(), self._schema, strict=True)
        ]
        self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()

    def verify(self) -> None:
        """`write` and `close` have told."""


def _columns(samples: list[Sample], sample_type: type[Sample], start_ns: int) -> Mapping[str, Array]:
    flat: dict[str, Array] = {}
    for name, array in arrays_of(samples, sample_type, start_ns=start_ns).items():
        flat |= flattened(name, array)
    return flat


def _cells(array: Array) -> list[Any]:
    if array.dtype == bool:
        array = array.astype(np.int64)
    values: list[Any] = array.tolist()
    return [" ".join(map(repr, v.tolist())) if hasattr(v, "tolist") else v for v in values]
