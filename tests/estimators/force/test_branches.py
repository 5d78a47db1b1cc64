import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import NoContact
from microdrivers.estimators.force.branches import find_branches
from tests.estimators.force.indentations import indented, part, recorded
from tests.estimators.force.indenter import PRESETS, Noise, Push


def branches_of(record):
    return find_branches(
        record.time_s, record.deformation_um, record.force_uN, deformation_sigma_um=0.06, force_sigma_uN=0.05
    )


@pytest.mark.parametrize(
    ("preset", "hold_s"), [("single", 0.0), ("unloading_springs", 2.0), ("slip_corrected", 0.0), ("viscoelastic", 0.0)]
)
def test_contact_reversals_and_release_are_found_to_the_frame(preset, hold_s):
    push = Push(hold_s=hold_s)
    truth, found = indented(PRESETS[preset], push), branches_of(recorded(preset, push))
    turn_s = push.rest_s + (push.depth_um - push.start_um) / push.speed_um_s
    assert found.onset_s is not None
    assert found.onset_s[0] - 0.01 <= truth.contact_s <= found.onset_s[1] + 0.01
    assert len(found.turns_s) == (2 if hold_s else 1)
    # The damper delays the tip's reversal by some tens of ms against the stage's.
    assert np.allclose(found.turns_s, [turn_s, turn_s + 2.0][: len(found.turns_s)], atol=0.1)
    last = truth.time_s[truth.in_contact][-1]
    assert found.released_s == pytest.approx(last, abs=0.07)


@pytest.mark.parametrize("preset", ["single", "unloading_springs", "slip_corrected"])
@pytest.mark.parametrize("seed", [1, 2])
def test_noise_hides_contact_and_release_no_farther_than_is_told(preset, seed):
    push = Push(rest_s=3.0)
    record = recorded(preset, push, Noise(force_uN=4.0), seed=seed)
    found = find_branches(
        record.time_s, record.deformation_um, record.force_uN, deformation_sigma_um=0.06, force_sigma_uN=4.0
    )
    truth = indented(PRESETS[preset], push)
    assert found.onset_s[0] - 0.01 <= truth.contact_s <= found.onset_s[1] + 0.01
    assert found.release_s[0] - 0.07 <= truth.time_s[truth.in_contact][-1] <= found.release_s[1] + 0.07
    assert len(found.turns_s) == 1


@given(st.floats(-30.0, -8.0), st.floats(60.0, 130.0), st.sampled_from([0.0, 1.5]), st.integers(0, 100))
@settings(max_examples=3)
def test_branches_cover_the_record_in_order(start_um, depth_um, hold_s, seed):
    record = recorded("slip_corrected", Push(start_um=start_um, depth_um=depth_um, hold_s=hold_s), seed=seed)
    found = branches_of(record)
    ranges = (found.approach, found.loading, found.hold, found.unloading, found.lost)
    assert [i for one in ranges for i in one] == list(range(len(record.time_s)))
    assert len(found.labels()) == len(record.time_s)
    assert bool(found.hold) == bool(hold_s)


def test_a_record_that_begins_or_ends_in_contact():
    record = recorded("unloading_springs")
    late = branches_of(part(record, 8.0, 99.0))
    assert late.onset_s is None
    assert len(late.approach) == 0
    assert len(late.lost) > 50
    early = branches_of(part(record, 0.0, 40.0))
    assert early.release_s is None
    assert len(early.unloading) > 200
    only_in = branches_of(part(record, 0.0, 20.0))
    assert only_in.turns_s == ()
    assert only_in.loading.stop == len(part(record, 0.0, 20.0).time_s)
    held = branches_of(part(recorded("unloading_springs", Push(hold_s=2.0)), 0.0, 30.0))
    assert len(held.hold) > 10
    assert len(held.unloading) == 0


@pytest.mark.parametrize("sigma_uN", [0.5, 2.0])
@pytest.mark.parametrize("preset", ["single", "unloading_springs"])
def test_a_noisy_record_that_ends_in_contact(preset, sigma_uN):
    record = part(recorded(preset, noise=Noise(force_uN=sigma_uN)), 0.0, 34.0)
    found = find_branches(
        record.time_s, record.deformation_um, record.force_uN, deformation_sigma_um=0.06, force_sigma_uN=sigma_uN
    )
    assert found.release_s is None
    assert len(found.unloading) > 100


def test_a_tip_that_leaves_at_the_reversal():
    record = recorded("single", Push(depth_um=20.0))
    found = branches_of(record)
    assert len(found.lost) > 50
    assert len(found.unloading) <= 2


def test_a_drifting_baseline_is_no_contact():
    found = branches_of(recorded("single", noise=Noise(drift_uN_per_s=0.05)))
    still = branches_of(recorded("single"))
    assert found.approach == still.approach
    assert found.lost == still.lost


@pytest.mark.parametrize("drift_uN_per_s", [-1.0, 1.0])
@pytest.mark.parametrize("preset", ["single", "unloading_springs"])
def test_a_drift_is_no_contact_at_either_end_however_slowly_it_is_pressed(preset, drift_uN_per_s):
    """At 2 µm/s it is an eighth of what the force grows by."""
    push = Push(start_um=-4.0, depth_um=80.0, speed_um_s=2.0, rest_s=2.0)
    truth = indented(PRESETS[preset], push)
    for seed in range(3):
        record = recorded(preset, push, Noise(0.03, 1.5, drift_uN_per_s=drift_uN_per_s), seed=seed)
        found = find_branches(
            record.time_s, record.deformation_um, record.force_uN, deformation_sigma_um=0.03, force_sigma_uN=1.5
        )
        assert found.onset_s[0] - 0.01 <= truth.contact_s <= found.onset_s[1] + 0.5
        assert found.release_s[0] - 0.1 <= truth.time_s[truth.in_contact][-1] <= found.release_s[1] + 0.1


def test_a_force_that_falls_while_pressed_is_refused():
    record = recorded("single")
    with pytest.raises(NoContact, match="does not rise"):
        branches_of(record._replace(force_uN=0.05 * np.random.default_rng(0).standard_normal(len(record.time_s))))
