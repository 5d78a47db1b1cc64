"""What is exported is what was recorded: to the bit in tables and HDF5, to the pixel in images."""

import csv
import math
import sys

import cv2
import h5py
import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet

from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.core.samples import Frame, OpticsTruth, XYThetaSample, ZoomSample
from microdrivers.recording.export import export_recording
from microdrivers.recording.export.pictures import eight_bit
from microdrivers.recording.export.target import file_names
from microdrivers.recording.image_sequence import ImageSequence
from microdrivers.recording.reader import Recording
from microdrivers.recording.views import data_frame


@pytest.fixture
def exported(recorded, tmp_path):
    def call(to, **options):
        with Recording(recorded.file) as recording:
            return export_recording(recording, to, tmp_path / "out", **options)

    return call


def samples(recorded, topic):
    return [sample for name, sample in recorded.published if name == topic]


def test_csv(exported, recorded, tmp_path):
    seen = []
    report = exported("csv", on_progress=lambda done, total: seen.append((done, total)))
    assert report.written == {tmp_path / "out" / "force.csv": 500, tmp_path / "out" / "camera.csv": 10}
    assert seen[-1] == (510, 510)
    with (tmp_path / "out" / "force.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0])[:3] == ["time_s", "t_ns", "device"]
    assert [float(row["force_uN"]) for row in rows] == [s.force_uN for s in samples(recorded, "force")]
    assert [int(row["t_ns"]) for row in rows] == [s.t_ns for s in samples(recorded, "force")]
    with (tmp_path / "out" / "camera.csv").open() as stream:
        assert next(csv.DictReader(stream))["principal_point_px_1"] == "nan"


def test_parquet(exported, recorded, tmp_path):
    exported("parquet")
    table = parquet.read_table(tmp_path / "out" / "force.parquet")
    assert table["force_uN"].to_pylist() == [s.force_uN for s in samples(recorded, "force")]
    assert table.schema.field("force_uN").metadata[b"units"] == b"uN"
    assert table.schema.metadata[b"topic"] == b"force"
    with Recording(recorded.file) as recording:
        for topic in ("force", "camera"):
            assert pd.read_parquet(tmp_path / "out" / f"{topic}.parquet").attrs == data_frame(recording, topic).attrs


def test_hdf5(exported, recorded, tmp_path):
    exported("hdf5")
    frames = samples(recorded, "camera")
    with h5py.File(tmp_path / "out" / "run.h5") as file:
        assert file.attrs["seed"] == 3
        assert file["attachments/rig.yaml"][()].tobytes() == b"name: test\n"
        force = file["force/force_uN"]
        assert force[()].tolist() == [s.force_uN for s in samples(recorded, "force")]
        assert (force.attrs["units"], force.chunks is not None) == ("uN", True)
        assert file["force/t_source"][0] == b"device"
        images = file["camera/image"]
        assert images.dtype == np.uint8
        assert np.array_equal(images, [frame.image for frame in frames])
        assert file["camera/frame_id"][()].tolist() == [frame.frame_id for frame in frames]
        assert (file["force/t_ns"].dtype, file["force/t_ns"].attrs["units"]) == (np.int64, "ns")
        assert (file["force/time_s"].dtype, file["force/time_s"].attrs["units"]) == (np.float64, "s")
        check_types_that_every_reader_takes(file)


def check_types_that_every_reader_takes(file):
    """Numbers, texts of a fixed length, no references: MATLAB's h5read and h5readatt give them as they are."""
    things = [file]
    file.visititems(lambda _name, thing: things.append(thing))
    types = [thing.dtype for thing in things if isinstance(thing, h5py.Dataset)]
    assert {dtype.kind for dtype in types} <= {"f", "i", "u", "S"}
    attributes = [value for thing in things for value in thing.attrs.values()]
    assert {type(value) for value in attributes} <= {str, np.int64}


def test_hdf5_of_frames_that_change_and_tuples_of_any_length(stage, tmp_path):
    with stage.recorder():
        stage.frame(0)
        stage.frame(1, shape=(20, 30), dtype=np.uint16)
        for number, corners in enumerate([(1.0, 2.0), (3.0, 4.0), ()]):
            stage.publish(
                "truth/optics",
                OpticsTruth(
                    t_ns=number, device="µ" * 5 * number, frame_seq=0, x_um=0.0, y_um=0.0, theta_deg=0.0,
                    corners_px=corners, jacobian_px_per_um=(1.0, 2.0, 3.0, 4.0), scale_px_per_um=1.0, angle_deg=0.0,
                    mirrored=True, zoom=1.0, tilt_deg=math.nan, flags=frozenset({"B", "A"}),
                ),
            )  # fmt: skip
    export_recording(Recording(stage.file), "hdf5", tmp_path / "out")
    with h5py.File(tmp_path / "out" / "run.h5") as file:
        assert file["camera/image"].shape == (1, 40, 60)
        assert (file["camera/image_2"].shape, file["camera/image_2"].dtype) == ((1, 20, 30), np.uint16)
        assert file["camera/image_2"].attrs["first_sample"] == 1
        truth = file["truth-optics"]
        assert [row.tolist() for row in truth["corners_px"]] == [[1.0, 2.0], [3.0, 4.0], []]
        assert truth["jacobian_px_per_um"].shape == (3, 4)
        assert truth["device"].asstr()[2] == "µ" * 10
        assert truth["flags"].asstr()[0] == "A B"
        assert truth["mirrored"][()].tolist() == [1, 1, 1]
    export_recording(Recording(stage.file), "csv", tmp_path / "csv")
    with (tmp_path / "csv" / "truth-optics.csv").open() as stream:
        assert [row["corners_px"] for row in csv.DictReader(stream)] == ["1.0 2.0", "3.0 4.0", ""]
    export_recording(Recording(stage.file), "parquet", tmp_path / "parquet")
    table = parquet.read_table(tmp_path / "parquet" / "truth-optics.parquet")
    assert table["corners_px"].to_pylist() == [[1.0, 2.0], [3.0, 4.0], []]
    report = export_recording(Recording(stage.file), "video", tmp_path / "video")
    assert "1 frames of another size" in report.remarks[1]


def test_images_are_a_sequence_again(optics_recording, tmp_path):
    with Recording(optics_recording) as recording:
        export_recording(recording, "images", tmp_path / "out")
        sequence = ImageSequence(tmp_path / "out" / "camera")
        published = {name: [s for _, s in recording.samples([name])] for name in ("camera", "stage", "zoom")}
    assert len(sequence) == 30
    assert [(row.x_um, row.y_um) for row in sequence.rows] == [(s.x_um, s.y_um) for s in published["stage"]]
    assert [row.zoom for row in sequence.rows] == [s.zoom for s in published["zoom"]]
    for row, frame in zip(sequence.rows, published["camera"], strict=True):
        assert np.array_equal(sequence.load(row), frame.image)


def record_a_drive(stage, *, referenced):
    """Ten poses, ten frames, and a zoom that comes before the fourth of them."""
    with stage.recorder():
        for seq in range(10):
            stage.clock.sleep(0.03)
            about = {"t_ns": stage.clock.now_ns(), "seq": seq, "moving": False, "on_target": True}
            known = {"referenced": referenced(seq), "x_um": 5.0 * seq, "y_um": -2.0 * seq, "theta_deg": 0.0}
            stage.publish("table", XYThetaSample(device="table", **known, **about))
            if seq >= 3:
                stage.publish("zoom", ZoomSample(device="zoom", zoom=1.5, position_steps=9, referenced=False, **about))
            stage.frame(seq)


def test_frames_without_a_pose_or_a_zoom_are_left_out_of_a_sequence(stage, tmp_path):
    record_a_drive(stage, referenced=lambda seq: seq < 8)
    with Recording(stage.file) as recording:
        report = export_recording(recording, "images", tmp_path)
    assert report.remarks == [
        "camera: frames without x_um, y_um in frames.csv: 2 of 10, since table was not referenced",
        "camera: frames without zoom in frames.csv: 3 of 10, since zoom has no sample before or after them",
    ]
    sequence = ImageSequence(tmp_path / "camera")
    assert [(row.x_um, row.y_um, row.zoom) for row in sequence.rows] == [(5.0 * s, -2.0 * s, 1.5) for s in range(3, 8)]
    assert sequence.flaws == ("frames without a pose (x_um, y_um): 2 of 10", "frames without a zoom: 3 of 10")


def test_poses_of_a_stage_that_was_never_referenced_are_no_places(stage, tmp_path):
    record_a_drive(stage, referenced=lambda _: False)
    with Recording(stage.file) as recording:
        export_recording(recording, "images", tmp_path)
    with pytest.raises(ConfigError, match=r"frames without a pose \(x_um, y_um\): 10 of 10") as caught:
        ImageSequence(tmp_path / "camera")
    assert "with the stage referenced" in caught.value.remedy


def test_what_a_damaged_recording_lacks_is_told_beside_what_is_exported(optics_recording, tmp_path):
    file = tmp_path / "run.mcap"
    data = bytearray(optics_recording.read_bytes())
    with Recording(optics_recording) as recording:
        assert len(list(recording.samples(["camera"]))) == 30
        place = next(offset for offset, (_, stamps) in recording._frames.items() if stamps.seq == 12)
        length = next(chunk.length for chunk in recording._scan.chunks if chunk.offset == place)
    data[place + length - 1] ^= 1
    file.write_bytes(data)
    with Recording(file) as recording:
        for form in ("images", "csv"):
            report = export_recording(recording, form, tmp_path / "out")
            assert report.remarks == [f"{tmp_path / 'out' / 'run-flaws.txt'}: what is wrong with the recording"]
        assert (tmp_path / "out" / "run-flaws.txt").read_text().splitlines() == recording.flaws
    with (tmp_path / "out" / "camera" / "frames.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["seq"] for row in rows if row["missing_before"] != "0"] == ["13"]
    assert rows[12]["missing_before"] == "1"


def test_a_video_shows_what_was_recorded(optics_recording, tmp_path):
    with Recording(optics_recording) as recording:
        export_recording(recording, "video", tmp_path)
        frames = [frame for _, frame in recording.samples(["camera"])]
    video = cv2.VideoCapture(str(tmp_path / "camera.avi"))
    for frame in frames:
        read, image = video.read()
        assert read
        assert np.abs(image[:, :, 0].astype(float) - frame.image).mean() < 3
    assert not video.read()[0]
    video.release()


def test_video(exported, tmp_path):
    exported("video")
    video = cv2.VideoCapture(str(tmp_path / "out" / "camera.avi"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 10
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20, rel=0.01)
    video.release()


def test_a_video_plays_at_the_rate_between_pauses(stage, tmp_path):
    with stage.recorder():
        for seq in range(20):
            stage.clock.sleep(2.0 if seq % 5 == 0 else 0.04)
            stage.frame(seq)
    with Recording(stage.file) as recording:
        report = export_recording(recording, "video", tmp_path)
    assert report.remarks == ["camera: it plays at 25 frames per second, without the pauses between frames"]
    video = cv2.VideoCapture(str(tmp_path / "camera.avi"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(25, rel=0.01)
    video.release()


def test_sixteen_bits_become_the_upper_eight(recorded):
    image = np.array([[0, 0x0FF0, 0x0FFF]], dtype=np.uint16)
    frame = Frame(t_ns=0, device="c", image=image, exposure_ms=1.0, frame_id=0, bit_depth=12, principal_point_px=(0, 0))
    assert eight_bit(frame).tolist() == [[0, 255, 255]]


def test_nothing_is_written_over_and_nothing_half_done_stays(exported, tmp_path, monkeypatch):
    exported("csv", topics=["camera"])
    before = (tmp_path / "out" / "camera.csv").read_bytes()
    with pytest.raises(ConfigError, match="never overwrites"):
        exported("csv")
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["camera.csv"]
    assert (tmp_path / "out" / "camera.csv").read_bytes() == before

    def interrupted(done, total):
        raise KeyboardInterrupt

    for to in ("parquet", "hdf5", "images", "video"):
        with pytest.raises(KeyboardInterrupt):
            exported(to, on_progress=interrupted)
        assert [file.name for file in (tmp_path / "out").iterdir()] == ["camera.csv"]


def test_what_cannot_be_exported_is_told(exported, monkeypatch):
    with pytest.raises(UnsupportedError, match="nothing on fource"):
        exported("csv", topics=["force", "fource"])
    with pytest.raises(UnsupportedError, match="nothing on force"):
        exported("images", topics=["force"])
    for to, module in (("parquet", "pyarrow"), ("hdf5", "h5py")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(UnsupportedError) as caught:
            exported(to)
        assert "microdrivers[export]" in caught.value.remedy


def test_file_names_are_safe_and_differ():
    names = file_names(["a/b", "a-b", "A/B", "../x", "", "µ m"])
    assert list(names.values()) == ["a-b", "a-b-2", "A-B-3", "-x", "topic", "µ_m"]
