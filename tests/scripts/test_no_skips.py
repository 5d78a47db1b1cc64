"""In CI a test that is skipped has failed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parents[1] / "conftest.py"

SKIPPED = {
    "a_call": "import pytest\ndef test_it(): pytest.skip('nothing there')\n",
    "a_mark": "import pytest\n@pytest.mark.skipif(True, reason='nothing there')\ndef test_it(): pass\n",
    "a_module": "import pytest\npytest.skip('nothing there', allow_module_level=True)\n",
    "a_fixture": "import pytest\n@pytest.fixture\ndef it(): pytest.skip('nothing there')\ndef test_it(it): pass\n",
}
EXPECTED = "import pytest\n@pytest.mark.xfail\ndef test_it(): assert False\n"


def run_in(folder, **strictness):
    kept = {name: value for name, value in os.environ.items() if name not in {"MICRODRIVERS_NO_SKIPS", "VCAN_RUN"}}
    options = "-q -rs -p no:cacheprovider --rootdir=. --continue-on-collection-errors -c"
    command = [sys.executable, "-m", "pytest", *options.split(), os.devnull, "."]
    return subprocess.run(command, cwd=folder, env=kept | strictness, capture_output=True, text=True)


@pytest.fixture
def suite(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST.read_text(encoding="utf-8"), encoding="utf-8")
    for name, text in SKIPPED.items():
        (tmp_path / f"test_{name}.py").write_text(text, encoding="utf-8")
    (tmp_path / "test_expected_failure.py").write_text(EXPECTED, encoding="utf-8")
    return tmp_path


def test_elsewhere_a_skip_is_a_skip(suite):
    done = run_in(suite)
    assert done.returncode == 0
    assert "1 xfailed" in done.stdout
    assert f"{len(SKIPPED)} skipped" in done.stdout


@pytest.mark.parametrize("why", ["MICRODRIVERS_NO_SKIPS", "VCAN_RUN"])
def test_in_ci_a_skip_is_a_failure_that_says_why(suite, why):
    done = run_in(suite, **{why: "1"})
    assert done.returncode != 0
    assert "1 xfailed" in done.stdout
    assert "skipped" not in done.stdout.splitlines()[-1]
    assert done.stdout.count("may not be skipped here") == len(SKIPPED)
    assert done.stdout.count("Skipped: nothing there") == len(SKIPPED)
