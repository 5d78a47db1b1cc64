import re

import numpy as np
import pytest

from microdrivers.core.errors import DataError, NoContact, SaturatedData, TargetLost
from microdrivers.estimators.force.record import IndentationRecord, check, runs, saturated, white_sigma
from tests.estimators.force.indentations import part, real, recorded


def changed(record: IndentationRecord, column: str, place, value) -> IndentationRecord:
    values = getattr(record, column).copy()
    values[place] = value
    return record._replace(**{column: values})


@pytest.fixture(scope="module")
def good():
    return recorded("single")


@pytest.mark.parametrize("preset", ["single", "unloading_springs", "slip_corrected", "viscoelastic"])
def test_good_records_pass(preset):
    check(recorded(preset))
    check(recorded(preset, stated=False))


def test_the_real_record_passes():
    check(real())


def refused(record: IndentationRecord, kind: type[DataError], match: str) -> None:
    with pytest.raises(kind, match=match) as caught:
        check(record)
    assert caught.value.remedy


def test_time_must_increase(good):
    refused(changed(good, "time_s", 300, good.time_s[299]), DataError, "time does not increase after")
    refused(changed(good, "time_s", 300, np.nan), DataError, "time_s is not a number")


@pytest.mark.parametrize("column", ["deformation_um", "force_uN"])
def test_nan_is_refused_unless_marked_as_lost(good, column):
    holed = changed(good, column, slice(300, 310), np.nan)
    refused(holed, DataError, f"{column} is not a number in 10 samples")
    unseen = np.zeros(len(good.time_s), dtype=bool)
    unseen[300:310] = True
    check(holed._replace(lost=unseen))


def test_a_gap_is_refused_and_a_dropped_frame_is_not(good):
    def without(start, stop):
        kept = np.delete(np.arange(len(good.time_s)), np.arange(start, stop))
        return IndentationRecord(good.time_s[kept], good.deformation_um[kept], good.force_uN[kept], 0.06, 0.05)

    check(without(300, 302))
    refused(without(300, 330), DataError, r"gap of 1\.0")


def test_a_force_in_millinewtons_is_noticed(good):
    mN = good._replace(force_uN=good.force_uN / 1000.0)
    refused(mN._replace(force_sigma_uN=0.0), DataError, "implausible units")
    refused(mN, DataError, "implausible units")


def test_other_units_are_noticed(good):
    refused(good._replace(deformation_um=good.deformation_um * 1000.0), DataError, "implausible units")
    refused(good._replace(deformation_um=good.deformation_um / 1e6, deformation_sigma_um=0.0), DataError, "implausible")
    refused(good._replace(force_uN=good.force_uN * 1000.0), DataError, "implausible units: a force of")
    # 30 µm deep in µN of noise 0.05: the modulus alone would be that of a soft gel.
    shallow = part(good, 0.0, 10.0)
    refused(shallow._replace(force_uN=shallow.force_uN / 1000.0), DataError, "implausible units")


def test_no_contact_is_told_from_a_weak_one(good):
    before = part(good, 0.0, 4.0)
    moving = before._replace(deformation_um=before.deformation_um + 5.0 * before.time_s)
    refused(moving, NoContact, "no contact")
    refused(good._replace(force_uN=np.full_like(good.force_uN, 1.5)), DataError, "the force is constant")


def test_a_force_of_the_wrong_sign_is_refused(good):
    refused(good._replace(force_uN=-good.force_uN), DataError, "pulls")


@pytest.mark.parametrize("preset", ["real", "single", "slip_corrected", "viscoelastic"])
def test_a_reversed_column_is_named(preset):
    record = real() if preset == "real" else recorded(preset)
    deformation, force = -record.deformation_um, -record.force_uN
    refused(record._replace(deformation_um=deformation), DataError, "the deformation is reversed")
    refused(record._replace(force_uN=force), DataError, "the specimen pulls")
    refused(
        record._replace(deformation_um=deformation, force_uN=force), DataError, "force and deformation are reversed"
    )


@pytest.mark.parametrize("preset", ["real", "single", "slip_corrected", "viscoelastic"])
def test_two_indentations_are_told_apart(preset):
    record = real() if preset == "real" else recorded(preset)
    length_s = record.time_s[-1] - record.time_s[0] + 1.0 / 30.0
    for times in (2, 3):
        time_s = np.concatenate([record.time_s + n * length_s for n in range(times)])
        many = IndentationRecord(time_s, np.tile(record.deformation_um, times), np.tile(record.force_uN, times))
        refused(many, DataError, f"holds {times} indentations: it presses again after")
        with pytest.raises(DataError) as caught:
            check(many)
        cut_s = float(re.search(r"cut it at ([\d.]+) s", caught.value.remedy)[1])
        check(part(many, 0.0, cut_s))


def test_a_force_that_falters_while_the_tool_goes_on_is_one_indentation(good):
    force = good.force_uN.copy()
    deep = int(0.8 * np.argmax(good.deformation_um))
    force[deep : deep + 30] *= 0.05  # a membrane that gives way and is met again
    check(good._replace(force_uN=force))


def test_a_deformation_that_does_not_change_is_refused(good):
    refused(good._replace(deformation_um=np.zeros_like(good.time_s)), DataError, "which is its noise")


def test_too_short_or_uneven_columns(good):
    refused(part(good, 0.0, 0.5), DataError, "at least 20 are needed")
    refused(good._replace(force_uN=good.force_uN[:-1]), DataError, "differ in length")


def test_saturation_is_found_and_only_refused_if_it_is_most_of_the_record(good):
    clipped = good._replace(force_uN=np.minimum(good.force_uN, 500.0))
    check(clipped)
    assert np.array_equal(saturated(clipped), good.force_uN >= 500.0)
    assert not saturated(good).any()
    refused(good._replace(force_uN=np.minimum(good.force_uN, 5.0)), SaturatedData, "end of its range")
    said = good.force_uN > 400.0
    assert np.array_equal(saturated(good._replace(saturated=said)), said)


def test_a_record_without_the_contact_point_is_refused(good):
    unseen = good.time_s > 10.0
    refused(good._replace(lost=unseen), TargetLost, "lost in")


def test_white_sigma_sees_the_noise_and_not_the_curve():
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 30.0, 900)
    curve = np.abs(np.sin(t / 3.0)) * 100.0
    assert white_sigma(curve + 0.05 * rng.standard_normal(900)) == pytest.approx(0.05, rel=0.15)
    assert np.isnan(white_sigma(curve[:8]))


def test_runs_are_half_open():
    assert runs(np.array([True, False, True, True])) == [(0, 1), (2, 4)]
    assert runs(np.array([False])) == []


def test_noise_of_rounded_values_is_that_of_the_rounding():
    force = 5.0 * np.round(np.linspace(0.0, 600.0, 900) / 5.0)
    assert white_sigma(force) == pytest.approx(5.0 / np.sqrt(12.0))
    assert white_sigma(np.linspace(0.0, 600.0, 900)) < 1e-9


def test_a_record_that_begins_deep_and_ends_free_pulls_nowhere():
    record = recorded("unloading_springs")
    turn = int(np.argmax(record.deformation_um))
    begins = turn - int(0.45 * turn)
    check(part(record, float(record.time_s[begins]), 99.0))


@pytest.mark.parametrize("name", ["deformation_sigma_um", "force_sigma_uN"])
@pytest.mark.parametrize("sigma", [-1.0, np.inf, "0.1", None])
def test_noise_that_is_none_is_refused(good, name, sigma):
    refused(good._replace(**{name: sigma}), DataError, f"{name} is ")


@pytest.mark.parametrize("column", ["time_s", "deformation_um", "force_uN"])
def test_a_column_that_holds_no_real_numbers_is_refused(good, column):
    values = getattr(good, column)
    refused(good._replace(**{column: values.astype(complex)}), DataError, f"{column} holds complex128")
    refused(good._replace(**{column: values.astype(str)}), DataError, f"{column} holds str")
    refused(good._replace(**{column: 5.0}), DataError, f"{column} is 5.0, not an array")
    refused(good._replace(**{column: values[:, np.newaxis]}), DataError, "differ in length")
    masked = np.ma.masked_array(values, mask=np.arange(len(values)) == 300)
    refused(good._replace(**{column: masked}), DataError, f"{column} is not a number")


def test_lists_are_taken_as_arrays(good):
    columns = [getattr(good, name).tolist() for name in ("time_s", "deformation_um", "force_uN")]
    found = check(
        IndentationRecord(*columns, good.deformation_sigma_um, good.force_sigma_uN, lost=[False] * len(columns[0]))
    )
    assert all(np.array_equal(one, other) for one, other in zip(found[:3], good[:3], strict=True))
