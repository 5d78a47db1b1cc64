"""`--replay` sets the estimators as they were in the run, but for what the user asks for."""

import json
from pathlib import Path

import pytest

SETTINGS = ("forgetting", "flush_frames", "sigma_drift_um_s")


@pytest.fixture
def result(run):
    def calibrate(*options, out, kind="optics"):
        assert run("calibrate", kind, *options, "--out", out).exit_code == 0
        return json.loads(Path(out, "result.json").read_text(encoding="utf-8"))

    return calibrate


def test_a_run_with_settings_of_its_own_gives_the_same_bits_without_naming_them(result):
    options = ("--forgetting", "0.95", "--flush-frames", "5", "--drift-um-s", "0.1", "--frames", "60")
    live = result(*options, out="live")
    again = result("--replay", "live/run.mcap", out="again")
    figures = ("projection", "covariance", "prediction_error_px", "notes")
    assert {name: again[name] for name in figures} == {name: live[name] for name in figures}
    settings = again["provenance"]["settings"]
    assert [settings[name] for name in SETTINGS] == [0.95, 5, 0.1]
    other = result("--replay", "live/run.mcap", "--forgetting", "0.99", out="other")
    assert [other["provenance"]["settings"][name] for name in SETTINGS] == [0.99, 5, 0.1]
    assert other["projection"] != live["projection"]


def test_so_does_an_identification(result, force_recording):
    again = result("--replay", force_recording, kind="force", out="again")
    assert again["provenance"]["settings"]["around_reversal"] == 3
    other = result("--replay", force_recording, "--leave-out", "4", kind="force", out="other")
    assert other["provenance"]["settings"]["around_reversal"] == 4
