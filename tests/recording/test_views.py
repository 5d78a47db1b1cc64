"""A topic as arrays, a DataFrame or a Dataset: every field, every sample, units."""

import sys

import numpy as np
import pytest

from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import (
    FineStageSample,
    ForceSample,
    Frame,
    OpticsEstimate,
    Sample,
    TrackedPoint,
    XYThetaSample,
    ZoomSample,
)
from microdrivers.recording.columns import columns_of, unit_of
from microdrivers.recording.reader import Recording
from microdrivers.recording.schemas import UnsupportedType, fields_of, sample_types
from microdrivers.recording.views import data_frame, dataset, start_ns, structured_array


def test_every_sample_type_has_columns_for_all_its_fields():
    for kind in sample_types().values():
        if kind is Frame:
            continue
        try:
            expected = [field.name for field in fields_of(kind)]
        except UnsupportedType:  # a type that another test has made
            continue
        assert [column.name for column in columns_of(kind)] == expected


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("x_um", "um"), ("scale_px_per_um", "px/um"), ("k2_uN_per_um3", "uN/um^3"), ("b_uN_s_per_um", "uN*s/um"),
        ("velocity_um_s", "um/s"), ("t_ns", "ns"), ("slip_rate_per_s", "1/s"), ("zoom", ""), ("s", ""),
    ],
)  # fmt: skip
def test_units_are_read_from_names(name, unit):
    assert unit_of(name) == unit


def test_descriptions_are_those_of_the_sample_type():
    described = {column.name: column.description for column in columns_of(OpticsEstimate)}
    assert described["t_ns"] == "physical instant, ns on the rig's clock"
    assert described["x_um"] == described["y_um"] == "stage pose at mid-exposure"
    assert described["scale_px_per_um"].startswith("M, the similarity")
    assert {column.name for column in columns_of(Sample)} == set(Sample.__struct_fields__)


@pytest.mark.parametrize("kind", [XYThetaSample, FineStageSample, ForceSample, ZoomSample, TrackedPoint, Frame])
def test_what_devices_publish_is_described(kind):
    assert [column.name for column in columns_of(kind) if not column.description] == []


def test_structured_array(recorded):
    recording = Recording(recorded.file)
    forces = [s for topic, s in recorded.published if topic == "force"]
    array = structured_array(recording, "force")
    assert array["force_uN"].tobytes() == np.array([s.force_uN for s in forces]).tobytes()
    assert np.signbit(array["raw_uN"]).all()
    assert array["t_ns"].tolist() == [s.t_ns for s in forces]
    assert array["time_s"][0] == (forces[0].t_ns - start_ns(recording)) / 1e9
    assert array.dtype["device"].kind == "U"
    frames = structured_array(recording, "camera")
    assert frames["principal_point_px"].shape == (10, 2)
    assert "image" not in frames.dtype.names


def test_data_frame_and_dataset(recorded):
    recording = Recording(recorded.file)
    frame = data_frame(recording, "camera")
    assert frame.index.name == "time_s"
    assert frame["principal_point_px_0"].tolist() == [29.5] * 10
    assert frame.attrs["units"]["principal_point_px_1"] == "px"
    assert frame.attrs["units"]["exposure_ms"] == "ms"
    found = dataset(recording, "force")
    assert found["force_uN"].attrs["units"] == "uN"
    assert found["time_s"].attrs["units"] == "s"
    assert found.sizes["time_s"] == 500


def test_what_is_not_there_is_told(recorded, monkeypatch):
    recording = Recording(recorded.file)
    with pytest.raises(UnsupportedError) as caught:
        structured_array(recording, "forec")
    assert "force" in caught.value.remedy
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UnsupportedError) as caught:
        data_frame(recording, "force")
    assert caught.value.remedy == "pip install 'microdrivers[export]'"
