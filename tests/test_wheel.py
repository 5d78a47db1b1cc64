"""The wheel holds all folders and works without the checkout."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

# The wheel is built once.
pytestmark = pytest.mark.xdist_group("wheel")

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built through the source distribution, as an index would."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return next(folder.glob("*.whl"))


def test_the_wheel_holds_the_four_folders_once_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    for needed in (
        "microdrivers/py.typed",
        "microdrivers/backends/pi_gcs/stage.py",
        "microdrivers/estimators/optics/recursion.py",
        "microdrivers/fakes/world/axis.py",
        "microdrivers/configs/workstation.yaml",
        "microdrivers/configs/worlds/workstation.yaml",
        "microdrivers/report/optics_report.html.j2",
    ):
        assert names.count(needed) == 1, needed
    tops = {name.split("/")[0] for name in names}
    assert tops == {"microdrivers", next(top for top in tops if top.endswith(".dist-info"))}
    assert not any("__pycache__" in name for name in names)


def test_the_wheel_calibrates_away_from_the_checkout(wheel, tmp_path):
    """The dependencies come from here; microdrivers itself comes from the wheel alone."""
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    code = (
        "import sys; sys.path = [p for p in sys.path if p != ''];"
        f"sys.path.insert(0, {str(site)!r});"
        "import microdrivers; from microdrivers.cli.main import main;"
        f"assert microdrivers.__file__.startswith({str(site)!r}), microdrivers.__file__;"
        f"main(['calibrate', 'optics', '--frames', '12', '--zoom-to', '0.9', '--out', {str(tmp_path / 'out')!r}])"
    )
    ran = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "calibration.yaml",
        "report.html",
        "result.json",
        "run.mcap",
    ]
