"""`calibrate force`: what cannot be analysed is refused, and what was measured is kept however it ends."""

import contextlib
import csv
import json
import pathlib

import pytest
import yaml

from microdrivers.cli.calibrate_force import _Opened, _run
from microdrivers.cli.run_output import RunOutput
from microdrivers.configs import shipped_rig
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.errors import LinkLost, MoveCancelled
from microdrivers.estimators.force.identify import IdentificationSettings
from microdrivers.report import force_report
from microdrivers.results.force import read_force_result
from tests.routines.indentation_source import K1, MadeUpSource

REAL = pathlib.Path(__file__).parents[1] / "data" / "force" / "chiaro_aebp1_30hz.csv"
KNOWN = {"source": "made up", "clock": "simulated", "settings": {}}


def measured(folder):
    with (folder / "record.csv").open() as file:
        return list(csv.DictReader(file))


def test_nothing_is_opened_if_the_operator_says_no(run, tmp_path):
    result = run("calibrate", "force", "--rig", shipped_rig(), "--out", tmp_path / "out", stdin="n\n")
    assert result.exit_code == 1
    assert "Is the specimen held" in result.stderr
    assert "no force guard" not in result.stderr
    assert "Aborted" in result.stderr
    assert not list(tmp_path.iterdir())


def test_who_presses_without_a_guard_is_told_before(run, tmp_path):
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8")) | {"safety": "none"}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    result = run("calibrate", "force", "--rig", "rig.yaml", "--out", tmp_path / "out", stdin="n\n")
    told, _, asked = result.stderr.partition("\n")
    assert told == "no force guard watches probe_force: the rig file's safety section states none"
    assert "Is the specimen held" in asked


def test_a_result_is_never_written_over(run, tmp_path):
    (tmp_path / "result.json").write_text("{}")
    result = run("calibrate", "force", "--no-record", "--out", tmp_path)
    assert (result.exit_code, "a result is never overwritten" in result.stderr) == (1, True)
    assert run("calibrate", "optics", "--no-record", "--out", tmp_path).exit_code == 1
    assert [file.name for file in tmp_path.iterdir()] == ["result.json"]


def test_an_error_is_json_where_the_result_would_be(run, tmp_path):
    file = tmp_path / "indentation.csv"
    file.write_text("time_s,indentation_um\n0,1\n")
    result = run("calibrate", "force", "--csv", file, "--json")
    assert result.exit_code == 1
    error = json.loads(result.stdout)["error"]
    assert error["kind"] in ("ConfigError", "ConfigErrors")
    assert error["file"] == str(file)
    assert error["remedy"]
    assert "to do:" in result.stderr
    assert run("calibrate", "force", "--csv", file).stdout == ""
    rig = json.loads(run("status", tmp_path / "none.yaml", "--json").stdout)
    assert rig["error"]["file"] == str(tmp_path / "none.yaml")


@pytest.mark.parametrize("value", ["nan", "inf", "-1"])
@pytest.mark.parametrize("option", ["--hold-s", "--depth-um", "--speed-um-s", "--max-force-uN"])
def test_a_figure_that_cannot_be_is_refused_before_anything_opens(run, tmp_path, option, value):
    result = run("calibrate", "force", "--rig", tmp_path / "no.yaml", option, value, "--out", tmp_path / "out")
    assert result.exit_code in (1, 2)
    assert "Is the specimen held" not in result.stderr
    assert "no.yaml" not in result.stderr
    assert value in result.stderr
    assert not list(tmp_path.iterdir())


def opened(source):
    return contextlib.nullcontext(_Opened(source, dict(KNOWN), IdentificationSettings()))


def test_an_experiment_that_fails_leaves_its_record_and_what_that_says(tmp_path, capsys):
    source = MadeUpSource(broken_off_at=600, error=MoveCancelled("the force guard has stopped it"))
    with pytest.raises(MoveCancelled):
        _run(opened(source), True, RunOutput("force", tmp_path, as_json=True))
    result = read_force_result(tmp_path / "result.json")
    assert not result.complete
    assert result.notes[-1] == (
        "The run ended early: the force guard has stopped it. The result holds what had been measured until then."
    )
    assert result.protocols["single"].k1_uN_per_um == pytest.approx(K1, rel=0.05)
    assert len(measured(tmp_path)) == 600
    assert "ended early" in (tmp_path / "report.html").read_text()
    told = f"what was measured is in {tmp_path / 'record.csv'}; to analyse it: microdrivers calibrate force --csv "
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("recorded", [False, True])
def test_an_interruption_before_the_contact_keeps_the_record(tmp_path, capsys, recorded):
    source = MadeUpSource(broken_off_at=60, error=KeyboardInterrupt())
    source.whereabouts = "probe_stage stands at x 10.0 µm; no contact was felt"
    if recorded:
        (tmp_path / "run.mcap").write_bytes(b"")
    with pytest.raises(KeyboardInterrupt):
        _run(opened(source), True, RunOutput("force", tmp_path, as_json=True))
    assert source.finished == 1
    assert len(measured(tmp_path)) == 60
    told = capsys.readouterr().err
    assert "record.csv; it cannot be analysed: no contact" in told
    assert "to analyse it" not in told
    assert (f"{tmp_path / 'run.mcap'} holds the samples until then" in told) is recorded
    assert source.whereabouts in told
    assert not (tmp_path / "result.json").exists()


@pytest.mark.parametrize("ended", [LinkLost("the port is gone"), KeyboardInterrupt()])
def test_a_probe_that_is_not_taken_away_leaves_what_was_measured(tmp_path, capsys, ended):
    def not_taken_away():
        source.whereabouts = "the probe was not taken away and may be pressing"
        raise ended

    source = MadeUpSource()
    source.finish = not_taken_away
    with pytest.raises(type(ended)):
        _run(opened(source), False, RunOutput("force", tmp_path, as_json=True))
    assert not read_force_result(tmp_path / "result.json").complete
    assert len(measured(tmp_path)) > 600
    assert source.whereabouts in capsys.readouterr().err


@pytest.mark.parametrize("recorded", [False, True])
def test_an_interruption_before_the_press_says_that_there_is_no_result(tmp_path, capsys, monkeypatch, recorded):
    def interrupted(_progress):
        raise KeyboardInterrupt

    source = MadeUpSource()
    monkeypatch.setattr(source, "prepare", interrupted)
    if recorded:
        (tmp_path / "run.mcap").write_bytes(b"")
    output = RunOutput("force", tmp_path, as_json=True)
    monkeypatch.setattr(output, "recorded", lambda *_: contextlib.nullcontext())
    output.folder = tmp_path
    with pytest.raises(KeyboardInterrupt):
        _run(opened(source), True, output)
    told = capsys.readouterr().err
    assert "interrupted before the specimen was pressed: there is no result" in told
    assert (f"{tmp_path / 'run.mcap'} holds the samples until then" in told) is recorded


def test_an_interruption_of_the_report_names_what_is_there(run, tmp_path, monkeypatch):
    def interrupted(*_arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(force_report, "write_force_report", interrupted)
    result = run("calibrate", "force", "--csv", REAL, "--out", tmp_path / "out")
    assert result.exit_code == 130
    assert "/out/ holds record.csv, result.json, specimen.yaml and lacks report.html" in result.stderr
    assert "choose another --out folder" in result.stderr
    assert "k1 " in result.stdout
    read_force_result(tmp_path / "out" / "result.json")
    assert len(list((tmp_path / "out").iterdir())) == 3


def test_an_interruption_that_is_kept_until_the_rig_is_closed_leaves_the_result_and_says_where_the_probe_is(
    tmp_path, capsys
):
    @contextlib.contextmanager
    def closing():
        yield _Opened(source, dict(KNOWN), IdentificationSettings())
        INTERRUPTION.requested = True

    source = MadeUpSource()
    source.whereabouts = "probe_stage stands at x 10.0 µm"
    assert _run(closing(), False, RunOutput("force", tmp_path, as_json=True)) == 130
    assert read_force_result(tmp_path / "result.json").complete
    assert f"interrupted; {source.whereabouts}" in capsys.readouterr().err


def _in_mN(rows):
    return [[row[0], row[1], str(float(row[2]) / 1000.0)] for row in rows]


def _in_ms(rows):
    return [[str(float(row[0]) * 1e6), *row[1:]] for row in rows]


def _constant(rows):
    return [[*row[:2], "0.01"] for row in rows]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_in_mN, "implausible units"),
        (_in_ms, "implausible units: samples come every 3.333e+04 s"),
        (_constant, "the force is constant, 0.01 µN"),
        (lambda rows: rows[:20] + rows[40:], "gap of 0.700 s"),
        (lambda rows: [*rows[:30], rows[29], *rows[30:]], "time does not increase"),
        (lambda rows: [[row[0], "nan", row[2]] if n % 3 else row for n, row in enumerate(rows)], "was lost in"),
        (lambda rows: rows[:15], "at least 20 are needed"),
    ],
)
def test_a_recording_that_cannot_be_analysed_is_refused(run, tmp_path, change, message):
    lines = [line for line in REAL.read_text().splitlines() if not line.startswith("#")]
    rows = change([line.split(",")[:3] for line in lines[1:]])
    file = tmp_path / "indentation.csv"
    file.write_text("\n".join(["time_s,indentation_um,force_uN", *(",".join(row) for row in rows)]))
    result = run("calibrate", "force", "--csv", file, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert message in result.stderr
    assert "to do:" in result.stderr
    assert not (tmp_path / "out").exists()
