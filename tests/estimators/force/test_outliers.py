"""Single samples far off their neighbours are named, and nothing else is."""

import numpy as np
import pytest

from microdrivers.estimators.force.identify import identify
from microdrivers.estimators.force.outliers import named_outliers, outliers
from microdrivers.estimators.force.prepared import Margins, prepare
from microdrivers.estimators.force.record import white_sigma
from tests.estimators.force.indentations import real, recorded
from tests.estimators.force.indenter import PRESETS, Noise, Push

AT = 510


def named(record):
    return named_outliers(prepare(record, around_reversal=2, margins=Margins.same(0.5)))


@pytest.mark.parametrize("column", ["force_uN", "deformation_um"])
def test_an_outlier_is_named_with_its_time(column):
    record = recorded("single")
    values = getattr(record, column).copy()
    values[AT] += 40.0
    (note,) = named(record._replace(**{column: values}))
    assert f"the {column.split('_')[0]} is far off its neighbours in sample {AT + 1} at" in note
    assert f"{record.time_s[AT]:.3f} s by +4" in note or f"{record.time_s[AT]:.3f} s by +39" in note
    lost = np.arange(len(values)) == AT
    assert named(record._replace(**{column: values}, lost=lost)) == []


def test_a_result_names_it():
    record = real()
    force = record.force_uN.copy()
    force[20] += 0.02
    assert any(
        "far off its neighbours in sample 21 at" in note for note in identify(record._replace(force_uN=force)).notes
    )


def test_all_of_many_are_counted():
    record = recorded("single")
    force = record.force_uN.copy()
    force[[200, 300, 400, 500, 600]] -= 30.0
    (note,) = named(record._replace(force_uN=force))
    assert note.count(" at ") == 3
    assert "and 2 more" in note


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize("push", [Push(), Push(depth_um=20.0), Push(depth_um=60.0, hold_s=3.0)])
def test_contact_reversal_and_release_are_no_outliers(preset, push):
    for seed, noise in enumerate((Noise(), Noise(), Noise(0.01, 0.005))):
        record = recorded(preset, push, noise, seed=seed)
        for values, sigma in ((record.force_uN, noise.force_uN), (record.deformation_um, noise.deformation_um)):
            assert not len(outliers(values, sigma))


def test_the_real_record_has_none():
    record = real()
    for values in (record.force_uN, record.deformation_um):
        assert not len(outliers(values, white_sigma(values)))
