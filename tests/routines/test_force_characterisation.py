"""The characterisation, whatever publishes the samples: found again, kept when it ends badly, told in the result."""

import contextlib
import json
import re

import msgspec
import numpy as np
import pytest

from microdrivers.core.errors import ConfigError, DataError, LinkLost, SaturatedData
from microdrivers.core.samples import ForceSample, RoutineNote
from microdrivers.estimators.force.identify import identify
from microdrivers.estimators.force.record import IndentationRecord
from microdrivers.recording.indentation_table import IndentationTable
from microdrivers.report.force_quantities import camera_text
from microdrivers.report.force_report import force_report_html
from microdrivers.report.force_summary import force_summary
from microdrivers.report.number_format import significant
from microdrivers.results.force import read_force_result
from microdrivers.results.specimen import read_specimen
from microdrivers.routines.force import Characterisation, IndentationPlayback
from microdrivers.routines.progress import SilentProgress
from tests.estimators.force.indentations import recorded
from tests.routines.indentation_source import K1, K2, REAL, B, MadeUpSource, result_of


def test_the_specimen_is_found_again(characterised):
    _, _, result, _ = characterised
    single = result.protocols["single"]
    assert single.k1_uN_per_um == pytest.approx(K1, rel=0.01)
    assert single.k2_uN_per_um3 == pytest.approx(K2, rel=0.03)
    assert single.b_uN_s_per_um == pytest.approx(B, rel=0.03)
    assert result.best == "single"
    assert not result.misfit.found
    assert single.m_kg is None
    assert not single.identifiable.m


def test_the_camera_alone_tells_the_force_of_a_fresh_indentation(characterised):
    source, run, result, published = characterised
    assert source.indentations == 2
    assert result.vision_force_error_percent is not None
    assert result.vision_force_error_percent <= 5.0
    assert len(published["force"]) == len(run.check.forces)
    assert result.vision_check.samples > 0.9 * len(run.check.samples) - 20


def test_the_worst_of_the_camera_is_said(characterised):
    _, _, result, _ = characterised
    check, traces = result.vision_check, result.traces
    off = np.abs(np.array(traces.check_vision_uN) - np.array(traces.check_force_uN))
    assert check.largest_error_uN == pytest.approx(off.max())
    assert check.largest_error_s == traces.check_time_s[int(np.argmax(off))]
    assert f"at most {significant(check.largest_error_uN, 3)} µN off" in force_summary(result)
    worst = camera_text(check.model_copy(update={"largest_error_s": 20.0, "deepest_s": 19.8}))
    assert worst.endswith("off, at the reversal")


def test_estimates_are_published_while_it_runs(characterised):
    _, run, _, published = characterised
    assert published["specimen"] == run.first.estimates
    assert published["specimen"][-1].valid
    assert published["specimen"][-1].k1_uN_per_um == pytest.approx(K1, rel=0.2)


def test_the_scale_is_part_of_the_uncertainty(characterised):
    _, run, _, _ = characterised
    far = run._replace(setup=run.setup._replace(scale_sigma_px_per_um=0.0025))
    fit = result_of(far).protocols["single"]
    assert fit.k1_sigma_uN_per_um == pytest.approx(0.01 * fit.k1_uN_per_um, rel=0.02)
    assert fit.k2_sigma_uN_per_um3 == pytest.approx(0.03 * fit.k2_uN_per_um3, rel=0.02)


def test_the_tool_is_away_afterwards(characterised):
    assert characterised[0].finished == 1


def test_the_result_reads_back(characterised, tmp_path):
    _, _, result, _ = characterised
    result.write_json(tmp_path / "result.json")
    assert read_force_result(tmp_path / "result.json") == result
    result.write_specimen(tmp_path / "specimen.yaml")
    assert "k1_uN_per_um" in (tmp_path / "specimen.yaml").read_text()


def test_the_specimen_file_reads_force_as_the_run_did(characterised, tmp_path):
    _, run, result, _ = characterised
    result.write_specimen(tmp_path / "specimen.yaml")
    known = run.identification.protocols[run.identification.best].model()
    model = read_specimen(tmp_path / "specimen.yaml")
    # The file's covariance has the scale's own uncertainty besides.
    assert len(model.covariance) == 9
    assert model._replace(covariance=()) == known._replace(covariance=())
    assert model.residual_uN > 0.0


def test_a_specimen_file_of_a_misfit_is_read_with_a_warning(characterised, tmp_path, caplog):
    file = tmp_path / "specimen.yaml"
    characterised[2].write_specimen(file)
    read_specimen(file)
    assert not caplog.text
    file.write_text(file.read_text().replace("misfit: false", "misfit: true"))
    read_specimen(file)
    assert f"{file}: the model does not explain its specimen within noise" in caplog.text


def test_a_specimen_file_without_a_speed_back_knows_nothing_of_that_way(characterised, tmp_path):
    file = tmp_path / "specimen.yaml"
    characterised[2].write_specimen(file)
    file.write_text("".join(line for line in file.read_text().splitlines(True) if "fastest_unloading" not in line))
    model = read_specimen(file)
    assert model.fastest_unloading_um_s == 0.0


def test_pressed_and_valid_are_told_apart_where_the_specimen_slips(tmp_path):
    record = recorded("slip_corrected")
    file = tmp_path / "indentation.csv"
    rows = zip(record.time_s, record.deformation_um, record.force_uN, strict=True)
    file.write_text("time_s,indentation_um,force_uN\n" + "".join(f"{t},{x},{f}\n" for t, x, f in rows))
    result = result_of(Characterisation(IndentationPlayback(IndentationTable(file))).run(), clock="recorded")
    setup = result.setup
    assert result.best == "slip_corrected"
    slipped_um = result.slip.offset_um * (1.0 - np.exp(-result.slip.rate_per_s * setup.pressed_um / 5.0))
    assert setup.pressed_um - setup.deepest_um == pytest.approx(slipped_um, abs=1.0)
    # On the way back the holder gives way towards the tip: x shrinks faster than the tool goes.
    assert setup.speed_um_s == pytest.approx(5.0, abs=0.1)
    assert setup.unloading_speed_um_s == pytest.approx(5.0, abs=0.1)
    assert setup.fastest_unloading_um_s > 5.1
    summary = force_summary(result)
    assert re.search(rf"Pressed +{significant(setup.pressed_um, 4)} µm", summary)
    assert f"compression up to {significant(setup.deepest_um, 4)} µm" in summary
    assert "x* of eq. (26)" in summary


@pytest.mark.parametrize(("speed_um_s", "why"), [(5.0, ""), (2.0, "used up any part"), (2.9, "may have used up 1")])
def test_a_slip_that_the_approach_has_used_up_in_part_is_not_quoted(tmp_path, speed_um_s, why):
    record = recorded("slip_corrected")
    file = tmp_path / "indentation.csv"
    rows = zip(record.time_s, record.deformation_um, record.force_uN, strict=True)
    file.write_text("time_s,indentation_um,force_uN\n" + "".join(f"{t},{x},{f}\n" for t, x, f in rows))
    run = Characterisation(IndentationPlayback(IndentationTable(file))).run()
    setup = run.setup._replace(speed_um_s=speed_um_s, touch_uN=1.0, touched_s=0.05)
    slip = result_of(run._replace(setup=setup)).slip
    assert slip.identifiable == (not why)
    assert why in slip.reason
    assert bool(slip.reason) == bool(why)


def test_nothing_is_determined_where_the_sensor_was_tared_in_contact(tmp_path):
    run = Characterisation(IndentationPlayback(IndentationTable(REAL))).run()
    assert run.identification.contact.seen == "nothing"
    for touch_uN, live in ((None, False), (1.0, True)):
        result = result_of(run._replace(setup=run.setup._replace(touch_uN=touch_uN)))
        told = [
            fit.identifiable.reasons.get("k1", "").endswith("zero was taken there") for fit in result.protocols.values()
        ]
        assert told == [live] * len(told)
        assert any(note.startswith("Nothing is determined") for note in result.notes) == live


def test_a_surface_that_lies_elsewhere_than_the_contact_that_was_felt_is_said(characterised):
    _, run, result, _ = characterised
    pressed = [
        msgspec.structs.replace(sample, tip_um=sample.deformation_um + 31.0) for sample in run.first.deformations
    ]
    elsewhere = run._replace(first=run.first._replace(deformations=pressed))
    assert not any("surface 31 µm" in note for note in [*result.notes, *result_of(elsewhere).notes])
    live = result_of(elsewhere._replace(setup=run.setup._replace(touch_uN=1.0, touched_s=0.05)))
    assert any("shows the surface 31 µm beyond where the approach felt a contact" in note for note in live.notes)


def test_a_specimen_file_without_what_it_needs_is_refused(characterised, tmp_path):
    file = tmp_path / "specimen.yaml"
    characterised[2].write_specimen(file)
    file.write_text(file.read_text().replace("contact_um", "contact"))
    with pytest.raises(ConfigError, match="contact_um"):
        read_specimen(file)


def test_the_same_samples_give_the_same_bits():
    first, second = (Characterisation(MadeUpSource(seed=4)).run(check=False) for _ in range(2))
    assert first.first.estimates == second.first.estimates
    assert result_of(first).protocols == result_of(second).protocols


def test_what_was_measured_is_kept_when_it_ends_with_an_error():
    source = MadeUpSource(broken_off_at=200, error=LinkLost("unplugged"))
    characterisation = Characterisation(source)
    with pytest.raises(LinkLost):
        characterisation.run()
    assert len(characterisation.first.samples) > 190
    assert source.finished == 1


def test_a_force_that_came_between_two_frames_is_said():
    class Hits(MadeUpSource):
        def indent(self, begin, progress):
            try:
                super().indent(begin, progress)
            finally:
                hit = ForceSample(t_ns=self._now_ns + 1_000_000, device="force", seq=999, force_uN=302.0, raw_uN=302.0)
                self.bus.topic("force", ForceSample).publish(hit)

    error = LinkLost("stopped by the guard")
    characterisation = Characterisation(Hits(broken_off_at=60, error=error))
    with pytest.raises(LinkLost):
        characterisation.run()
    assert characterisation.partial(error) is None
    assert re.match(r"up to 302 µN was felt, but .* none of the \d+ frames", characterisation.tells_nothing)


def test_an_interruption_identifies_what_there_is():
    source = MadeUpSource(broken_off_at=420, error=KeyboardInterrupt())
    run = Characterisation(source).run()
    result = result_of(run)
    assert not result.complete
    assert list(result.protocols) == ["loading"]
    assert result.protocols["loading"].k1_uN_per_um == pytest.approx(K1, rel=0.1)
    assert source.finished == 1


@pytest.mark.parametrize(
    ("error", "told"),
    [(KeyboardInterrupt(), "it was interrupted"), (LinkLost("cut"), "cut"), (None, "")],
)
def test_the_end_is_noted_for_a_replay(error, told):
    source = MadeUpSource(broken_off_at=420 if error is not None else None, error=error)
    with contextlib.suppress(LinkLost):
        Characterisation(source).run(check=False)
    done = source.bus.topic("routine", RoutineNote).latest
    assert (done.kind, json.loads(done.content)) == ("force/done", {"ended_by": told})


def test_an_interruption_before_anything_touched_is_told():
    source = MadeUpSource(broken_off_at=20, error=KeyboardInterrupt())
    with pytest.raises(DataError):
        Characterisation(source).run()
    assert source.finished == 1


@pytest.mark.parametrize(("frames", "told"), [(60, None), (96, None), (200, 3.0)])
def test_a_fresh_indentation_that_is_broken_off_tells_of_the_camera_only_what_it_saw(frames, told):
    """Contact is in frame 90, the reversal in frame 450."""
    source = MadeUpSource(error=KeyboardInterrupt())

    class BreaksOffTheFresh(SilentProgress):
        def step(self, text):
            if text.startswith("a fresh indentation"):
                source._broken_off_at = frames

    result = result_of(Characterisation(source).run(BreaksOffTheFresh()))
    assert not result.complete
    said = [note for note in result.notes if "before the probe had pressed noticeably" in note]
    if told is None:
        assert result.vision_check is None
        assert result.vision_force_error_percent is None
        assert said
    else:
        assert result.vision_force_error_percent < told
        assert result.vision_check.deepest_s is None  # no reversal yet
        assert not said


def test_the_drift_of_the_picture_is_taken_off():
    run = Characterisation(MadeUpSource(drift_um_s=0.01)).run(check=False)
    assert run.first.drift.rate_um_s == pytest.approx(0.01, abs=1e-6)
    drifted = [
        sample.deformation_um - frame.deformation_um
        for sample, frame in zip(run.first.samples, run.first.frames, strict=True)
    ]
    assert drifted[-1] - drifted[0] == pytest.approx(0.01 * (run.record.time_s[-1] - run.record.time_s[0]))
    result = result_of(run)
    assert result.setup.image_drift_um_s == run.first.drift.rate_um_s
    # The offset of a slip is no better known than the drift.
    drift_um = result.setup.image_drift_sigma_um_s * run.identification.contact_duration_s
    assert result.slip.offset_sigma_um > drift_um > 0.0
    assert result.slip.offset_sigma_um > run.identification.slip.sigma_offset_um
    assert "of the picture against the probe" in force_report_html(result)


def test_a_tip_that_is_held_at_the_end_tells_no_drift():
    run = Characterisation(MadeUpSource(drift_um_s=0.01, stuck_uN=5.0)).run(check=False)
    assert run.first.drift is None
    assert run.first.frames == run.first.samples
    assert result_of(run).setup.image_drift_um_s is None


def test_frames_without_a_track_are_kept_and_marked():
    lost = range(250, 280)
    run = Characterisation(MadeUpSource(lost=lost)).run(check=False)
    assert np.flatnonzero(run.record.lost).tolist() == list(lost)
    assert len(run.record.time_s) == len(run.first.samples) + len(lost)
    assert sum("LOST" in frame.flags for frame in run.first.frames) == len(lost)
    result = result_of(run)
    assert result.excluded_samples["frames_lost"] == len(lost)
    assert result.traces.deformation_um[250] is None
    assert result.protocols["single"].k1_uN_per_um == pytest.approx(K1, rel=0.05)
    assert any("not seen in 30 frames" in note for note in result.notes)
    assert "<svg" in force_report_html(result)


def test_a_sensor_at_the_end_of_its_range_is_said():
    run = Characterisation(MadeUpSource(range_uN=250.0)).run(check=False)
    assert np.sum(run.record.saturated) == run.first.unmatched["SATURATED"] > 30
    result = result_of(run)
    assert result.excluded_samples["saturated"] == run.first.unmatched["SATURATED"]
    assert any("end of its range" in note for note in result.notes)
    assert 240.0 < result.setup.largest_force_uN < 250.0
    assert "µN, where the sensor’s range ends" in force_summary(result)
    assert result.protocols["single"].k1_uN_per_um == pytest.approx(K1, rel=0.05)


def test_a_sensor_that_is_at_its_end_nearly_always_is_refused():
    with pytest.raises(SaturatedData, match="end of its range"):
        Characterisation(MadeUpSource(range_uN=100.1)).run(check=False)


def test_what_was_measured_is_identified_to_the_last_sample():
    table = IndentationTable(REAL)
    run = Characterisation(IndentationPlayback(table)).run()
    assert len(run.record.time_s) == len(table)
    columns = (np.array(table.column(name)) for name in ("time_s", "indentation_um", "force_uN"))
    found = identify(IndentationRecord(*columns))
    for name, fit in run.identification.protocols.items():
        assert fit.error_percent == pytest.approx(found.protocols[name].error_percent, rel=1e-3), name


def test_a_real_indentation_is_fitted_as_well_as_it_can_be():
    run = Characterisation(IndentationPlayback(IndentationTable(REAL))).run()
    result = result_of(run, clock="recorded")
    assert 5.0 <= result.protocols["loading"].error_percent <= 5.6  # the best possible is 5.31 %
    assert result.protocols["single"].error_percent <= 16.0
    assert not result.protocols["loading"].identifiable.b
    assert result.largest_speed_um_s is None  # nothing that the damper would have to tell
    assert result.misfit.found
    assert result.misfit.found_by == "size"
    assert result.misfit.p_value > 0.01
    assert result.vision_force_error_percent is None
    assert result.setup.speed_um_s == pytest.approx(5.9, abs=0.1)
    assert result.setup.fastest_um_s == pytest.approx(7.0, abs=0.1)
    assert result.setup.fastest_unloading_um_s == pytest.approx(99.0, abs=2.0)
