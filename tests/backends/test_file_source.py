"""Recordings in the place of a camera: image sequences and films, in simulated and in real time."""

import cv2
import numpy as np
import pytest

from microdrivers.backends.camera import CameraDeviceSettings
from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import LinkLost, UnsupportedError

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")


def camera_on(source, *, size=(64, 48), clock=None, **settings):
    rig = CameraDeviceSettings(source=source, sensor_size_px=size, pixel_pitch_um=5.0, **settings)
    return SourceCamera("film", rig, clock=clock or SimulatedClock(), bus=Bus())


def numbered_image(number, dtype=np.uint8):
    ramp = np.arange(48 * 64, dtype=np.uint32).reshape(48, 64) + number * 1000
    return ramp.astype(dtype)


@pytest.fixture
def folder(tmp_path):
    for number in (3, 4, 5, 7, 8, 12):
        cv2.imwrite(str(tmp_path / f"img_{number:04d}.png"), numbered_image(number))
    (tmp_path / "img_notes.txt").write_text("no image")
    return tmp_path


@pytest.fixture
def film(tmp_path):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    assert writer.isOpened()
    for number in range(6):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    return path


def all_frames(camera):
    frames = []
    with pytest.raises(LinkLost, match="has ended"):
        frames.extend(iter_into(camera, frames))
    return frames


def iter_into(camera, frames):
    for frame in camera.frames():
        frames.append(frame)
    return ()


def test_images_are_played_in_order_at_the_rate_and_missing_ones_are_dropped_frames(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png", rate_hz=50.0, exposure_ms=4.0)
    camera.open()
    frames = all_frames(camera)
    assert [frame.frame_id for frame in frames] == [3, 4, 5, 7, 8, 12]
    assert [frame.dropped_before for frame in frames] == [0, 0, 0, 1, 0, 3]
    assert np.diff([frame.t_ns for frame in frames]).tolist() == [20_000_000] * 5
    assert frames[0].t_ns == 2_000_000  # the middle of the first exposure
    for frame in frames:
        assert (frame.image == numbered_image(frame.frame_id)).all()


def test_the_end_is_a_lost_link_and_opening_it_again_plays_from_the_start(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png")
    camera.open()
    assert len(all_frames(camera)) == 6
    assert camera.link == "lost"
    camera.close()
    camera.open()
    assert camera.grab().frame_id == 3


def test_each_grab_is_the_next_image_exposed_after_the_call(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png", exposure_ms=3.0)
    camera.open()
    for expected in (3, 4, 5, 7):
        called_ns = camera.clock.now_ns()
        frame = camera.grab()
        assert frame.frame_id == expected
        assert frame.t_ns - 1_500_000 >= called_ns
        camera.clock.sleep(0.01)


def test_sixteen_bits_are_kept(tmp_path):
    deep = numbered_image(5, np.uint16) * 13
    cv2.imwrite(str(tmp_path / "a0.tif"), deep)
    camera = camera_on(f"images://{tmp_path}/a%d.tif")
    camera.open()
    frame = camera.grab()
    assert camera.settings.pixel_format == "mono16"
    assert frame.bit_depth == 16
    assert (frame.image == deep).all()


def test_a_region_is_cut_out_and_binning_refused(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png")
    camera.open()
    assert camera.configure(roi=(10, 4, 20, 30)).roi == (10, 4, 20, 30)
    frame = camera.grab()
    assert (frame.image == numbered_image(3)[4:34, 10:30]).all()
    assert frame.principal_point_px == (31.5 - 10, 23.5 - 4)
    with pytest.raises(UnsupportedError, match="binning 1 only"):
        camera.configure(binning=2)
    assert camera.settings.binning == 1


def test_gain_is_read_back_as_what_it_is(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png", gain=4.0)
    camera.open()
    assert camera.settings.gain == 1.0


def test_a_damaged_image_is_named(folder):
    (folder / "img_0005.png").write_bytes(b"")
    camera = camera_on(f"images://{folder}/img_%04d.png")
    camera.open()
    with pytest.raises(LinkLost, match=r"film: img_0005\.png is not a readable image"):
        list(camera.frames())


def test_an_image_that_has_disappeared_is_named(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png")
    camera.open()
    (folder / "img_0004.png").unlink()
    with pytest.raises(LinkLost, match=r"img_0004\.png has disappeared"):
        list(camera.frames())


@pytest.mark.parametrize(
    ("source", "error", "words"),
    [
        ("images://{}/other_%04d.png", LinkLost, "no image in .* is called other_%04d.png"),
        ("images://{}/nowhere/img_%04d.png", LinkLost, "cannot read folder"),
        ("images://{}/img_0003.png", UnsupportedError, "no pattern"),
        ("video://{}/none.avi", LinkLost, "there is no film"),
        ("video://{}/img_notes.txt", LinkLost, "not a film"),
    ],
)
def test_wrong_names_are_typed_errors(folder, source, error, words):
    camera = camera_on(source.format(folder))
    with pytest.raises(error, match=words) as caught:
        camera.open()
    assert caught.value.remedy
    assert camera.link == "closed"


def test_a_wrong_size_is_refused(folder):
    camera = camera_on(f"images://{folder}/img_%04d.png", size=(640, 480))
    with pytest.raises(UnsupportedError, match=r"has \(64, 48\) px"):
        camera.open()


def test_a_film_is_played_in_grey_from_its_first_image(film):
    camera = camera_on(f"video://{film}", rate_hz=100.0)
    for _ in range(2):
        camera.open()
        frames = all_frames(camera)
        assert [frame.frame_id for frame in frames] == list(range(6))
        assert [round(float(frame.image.mean())) for frame in frames] == pytest.approx(
            [0, 40, 80, 120, 160, 200], abs=2
        )
        assert np.diff([frame.t_ns for frame in frames]).tolist() == [10_000_000] * 5
        camera.close()


def test_recordings_play_in_real_time_too(folder):
    clock = SystemClock()
    camera = camera_on(f"images://{folder}/img_%04d.png", rate_hz=100.0, clock=clock)
    camera.open()
    frames = all_frames(camera)
    assert [frame.frame_id for frame in frames] == [3, 4, 5, 7, 8, 12]
    periods_ns = np.diff([frame.t_ns for frame in frames])
    assert (periods_ns >= 10_000_000).all()
    assert (periods_ns % 10_000_000 == 0).all()
    camera.close()
    clock.close()
    clock.check()
