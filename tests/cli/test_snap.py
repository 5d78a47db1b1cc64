"""snap: one fresh frame in a file, every bit of it."""

import cv2
import msgspec
import numpy as np
import pytest

from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.configs import shipped_rig


def test_snap_writes_a_fresh_frame_and_says_how_it_was_taken(run, tmp_path):
    result = run("snap", shipped_rig("microscope"), "--out", "a.png", "--exposure-ms", 4, "--fake")
    assert result.exit_code == 0, result.output
    image = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (480, 640)
    assert image.dtype == np.uint8
    for text in ("8 bit", "±0.1 ms (the camera's own stamp)", "exposure      4 ms", "saturated     no pixel"):
        assert text in result.stdout


class Deep(SourceCamera):
    """Twelve bits in sixteen, the brightest pixels at full scale, stamped at arrival."""

    def _take(self, raw):
        image = raw.image.astype(np.uint16) * 200 + 7
        image[:24] = 65535
        super()._take(msgspec.structs.replace(raw, image=image, t_ns=None))


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.TIFF"])
def test_snap_keeps_the_bit_depth(run, prepared, tmp_path, name):
    prepared(camera_fine=Deep)
    result = run("snap", shipped_rig("microscope"), "camera_fine", "--out", name, "--fake")
    assert result.exit_code == 0, result.output
    image = cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    assert (image[24:] % 200 == 7).all()
    assert "16 bit" in result.stdout
    assert "known by arrival only" in result.stdout
    assert "5 % of the pixels at 65535" in result.stdout


def test_snap_never_overwrites_unasked(run, tmp_path):
    file = tmp_path / "a.png"
    file.write_text("precious")
    refused = run("snap", shipped_rig("microscope"), "--out", "a.png", "--fake")
    assert refused.exit_code == 1
    assert "--force" in refused.output
    assert file.read_text() == "precious"
    assert run("snap", shipped_rig("microscope"), "--out", "a.png", "--fake", "--force").exit_code == 0
    assert cv2.imread(str(file)) is not None


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--out", "a.jpg"], "end the name in .png"),
        (["--out", "none/a.png"], "no such folder"),
        (["zoom", "--out", "a.png"], "not a Camera"),
        (["--out", "a.png", "--exposure-ms", 0], "0 ms does not fit"),
        (["--out", "a.png", "--exposure-ms", -3], "does not fit"),
        (["--out", "a.png", "--exposure-ms", "nan"], "does not fit"),
        (["--out", "a.png", "--exposure-ms", "inf"], "does not fit"),
    ],
)
def test_snap_refuses(run, tmp_path, arguments, what):
    result = run("snap", shipped_rig("microscope"), *arguments, "--fake")
    assert result.exit_code == 1
    assert what in result.output
    assert not list(tmp_path.iterdir())


def test_a_long_exposure_lowers_the_rate(run):
    result = run("snap", shipped_rig("microscope"), "--out", "a.png", "--exposure-ms", 80, "--fake")
    assert result.exit_code == 0, result.output
    assert "exposure      80 ms" in result.stdout
