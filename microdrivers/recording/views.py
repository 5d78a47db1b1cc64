"""A recorded topic as numpy arrays, a pandas DataFrame or an xarray Dataset, with units."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import Frame, Sample
from microdrivers.core.units import NS_PER_S
from microdrivers.recording.channels import TRUTH_PREFIX, literal
from microdrivers.recording.columns import Column, columns_of, describe, unit_of
from microdrivers.recording.reader import Recording
from microdrivers.recording.survey import TopicSummary

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Array = npt.NDArray[Any]

BATCH_SAMPLES = 4096


def optional_module(name: str, *, extra: str = "export") -> ModuleType:
    """Import a module that is not always there.

    Raises:
        UnsupportedError: it is not installed; the remedy names the extra.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        raise UnsupportedError(
            f"{error.name} is not installed", remedy=f"pip install 'microdrivers[{extra}]'"
        ) from error


def start_ns(recording: Recording) -> int:
    """Where `time_s` begins: the earliest instant that a sample describes, on the rig's clock; `truth/*` aside."""
    topics = {name: found for name, found in recording.topics.items() if found.count}
    measured = [found.first_t_ns for name, found in topics.items() if not name.startswith(TRUTH_PREFIX)]
    return min(measured or [found.first_t_ns for found in topics.values()], default=0)


def summary_of(recording: Recording, topic: str) -> TopicSummary:
    """What there is of a topic.

    Raises:
        UnsupportedError: the recording has no samples of it; the remedy names the topics that it has.
    """
    known = {name: found for name, found in recording.topics.items() if found.count}
    if topic not in known:
        raise UnsupportedError(
            f"{recording.file} has no samples on a topic {topic!r}",
            remedy=f"name one of {', '.join(known) or 'none: it has no samples'}",
        )
    return known[topic]


def arrays_of(samples: list[Sample], sample_type: type[Sample], *, start_ns: int) -> dict[str, Array]:
    """One array a column: `time_s`, then all fields; tuples of fixed length are two-dimensional."""
    columns = columns_of(sample_type)
    arrays: dict[str, Array] = {"time_s": np.array([(s.t_ns - start_ns) / NS_PER_S for s in samples], dtype="f8")}
    for column in columns:
        values = [column.value(sample) for sample in samples]
        arrays[column.name] = _array(column, values)
    return arrays


def _array(column: Column, values: list[Any]) -> Array:
    if column.shape == "fixed":
        return np.array(values, dtype=column.dtype).reshape(len(values), column.length)
    array = np.empty(len(values), dtype=column.dtype)
    if column.shape == "any":
        for index, value in enumerate(values):
            array[index] = np.array(value, dtype="f8" if column.kind == "doubles" else "i8")
    else:
        array[:] = values
    return array


def batches_of(
    recording: Recording, topic: str, *, start_ns: int, size: int = BATCH_SAMPLES
) -> Iterator[dict[str, Array]]:
    """A topic's columns, batch by batch; a camera's without images. Never holds more than one batch.

    Raises:
        UnsupportedError: there are no such samples.
    """
    kind = summary_of(recording, topic).sample_type
    batch: list[Sample] = []
    for _, sample in recording.samples((literal(topic),)):
        batch.append(without_image(sample))
        if len(batch) == size:
            yield arrays_of(batch, kind, start_ns=start_ns)
            batch = []
    if batch:
        yield arrays_of(batch, kind, start_ns=start_ns)


_NO_IMAGE: npt.NDArray[np.uint8] = np.zeros((0, 0), dtype=np.uint8)


def without_image(sample: Sample) -> Sample:
    """The sample; of a frame, one with an empty image: what is kept of it until a batch is full."""
    if not isinstance(sample, Frame):
        return sample
    fields = {name: getattr(sample, name) for name in sample.__struct_fields__}
    return Frame(**fields | {"image": _NO_IMAGE})


# ---------------------------------------------------------------------- views


def columns(recording: Recording, topic: str) -> Mapping[str, Array]:
    """All samples of a topic as one array a column; see `structured_array` for what the columns are.

    Raises:
        UnsupportedError: there are no such samples.
    """
    batches = list(batches_of(recording, topic, start_ns=start_ns(recording)))
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def structured_array(recording: Recording, topic: str) -> Array:
    """All samples of a topic as a numpy structured array, one record a sample.

    Fields: `time_s` since the recording's start, then those of the sample type, units in their names. Texts are of
    fixed width (`U…`), flags one text, tuples of a fixed length sub-arrays, tuples of any length objects. A camera's
    array has all but the images: `recording.samples([topic])` yields these.

    Raises:
        UnsupportedError: there are no such samples.
    """
    found = columns(recording, topic)
    kinds = {column.name: column for column in columns_of(summary_of(recording, topic).sample_type)}
    arrays = {
        name: array.astype(np.str_) if name in kinds and _is_text(kinds[name]) else array
        for name, array in found.items()
    }
    dtype = np.dtype([(name, array.dtype, array.shape[1:]) for name, array in arrays.items()])
    table = np.empty(len(found["time_s"]), dtype=dtype)
    for name, array in arrays.items():
        table[name] = array
    return table


def data_frame(recording: Recording, topic: str) -> pd.DataFrame:
    """All samples of a topic as a pandas DataFrame, indexed by `time_s`.

    A tuple of fixed length is one column an element, `name_0`, `name_1`, …. `attrs` holds `units` by column, `topic`,
    `description`, and `start_ns`, where `time_s` begins on the rig's clock.

    Raises:
        UnsupportedError: there are no such samples, or pandas is not installed.
    """
    pandas = optional_module("pandas")
    flat: dict[str, Array] = {}
    for name, array in columns(recording, topic).items():
        flat |= flattened(name, array)
    frame: pd.DataFrame = pandas.DataFrame({name: _listed(array) for name, array in flat.items()}).set_index("time_s")
    frame.attrs |= _attributes(recording, topic) | {"units": {name: unit_of_column(name) for name in flat}}
    return frame


def dataset(recording: Recording, topic: str) -> xr.Dataset:
    """All samples of a topic as an xarray Dataset along `time_s`; `units` and `long_name` are attributes.

    Raises:
        UnsupportedError: there are no such samples, or xarray is not installed.
    """
    xarray = optional_module("xarray")
    table = columns(recording, topic)
    described = {column.name: column for column in columns_of(summary_of(recording, topic).sample_type)}
    variables = {}
    for name, array in table.items():
        if name == "time_s":
            continue
        attributes = {"units": described[name].unit, "long_name": described[name].description}
        dimensions = ("time_s", f"{name}_element")[: array.ndim]
        variables[name] = (dimensions, array, {key: said for key, said in attributes.items() if said})
    time = ("time_s", table["time_s"], {"units": "s", "long_name": "time since the recording's start"})
    found: xr.Dataset = xarray.Dataset(variables, coords={"time_s": time}, attrs=_attributes(recording, topic))
    return found


def flattened(name: str, array: Array) -> dict[str, Array]:
    """An array as one-dimensional ones; those of a tuple are numbered."""
    if array.ndim == 1:
        return {name: array}
    return {f"{name}_{index}": array[:, index] for index in range(array.shape[1])}


def unit_of_column(name: str) -> str:
    """The unit of a column of `flattened`."""
    head, _, tail = name.rpartition("_")
    return unit_of(head if tail.isdecimal() else name)


def _is_text(column: Column) -> bool:
    return column.kind in ("string", "strings", "bytes")


def _listed(array: Array) -> Any:
    return list(array) if array.dtype == object else array


def _attributes(recording: Recording, topic: str) -> dict[str, Any]:
    kind = summary_of(recording, topic).sample_type
    return {
        "topic": topic, "sample_type": kind.__name__, "description": describe(kind), "start_ns": start_ns(recording),
    }  # fmt: skip
