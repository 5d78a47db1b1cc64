import numpy as np
import pytest

from microdrivers.estimators.force.structure import chi_square_tail, structure_test


@pytest.mark.parametrize(
    ("value", "degrees", "tail"), [(26.509, 40, 0.95), (55.758, 40, 0.05), (63.691, 40, 0.01), (5.991, 2, 0.05)]
)
def test_the_tail_of_chi_square_is_that_of_the_tables(value, degrees, tail):
    assert chi_square_tail(value, degrees) == pytest.approx(tail, rel=1e-3)


def test_the_tail_is_a_probability_at_the_ends():
    assert chi_square_tail(0.0, 40) == 1.0
    assert 0.0 <= chi_square_tail(1e6, 40) < 1e-300


def outcome_of(residual, noise=1.0):
    place = np.arange(len(residual))
    return structure_test([residual, residual[::-1]], place, residual * noise, np.full(len(residual), noise))


def test_white_noise_is_hardly_ever_a_misfit():
    rng = np.random.default_rng(0)
    found = [outcome_of(rng.standard_normal(900)) for _ in range(200)]
    # The two series are one and its mirror image: p-values are not uniform, but no misfit may be found.
    assert not any(test.found for test in found)
    assert "looks like noise" in found[0].text


def test_the_p_value_of_independent_noise_is_uniform():
    rng = np.random.default_rng(1)
    place, ones = np.arange(900), np.ones(900)
    p = [structure_test(rng.standard_normal((2, 900)), place, ones, ones).p_value for _ in range(300)]
    assert 0.02 <= np.mean(np.array(p) < 0.05) <= 0.09


def test_a_slow_residual_is_a_misfit():
    slow = 2.0 * np.sin(np.arange(900) / 40.0)
    found = outcome_of(slow + np.random.default_rng(2).standard_normal(900), noise=0.4)
    assert found.found
    assert found.structured_uN == pytest.approx(0.4 * 2.0 / np.sqrt(2.0), rel=0.1)
    assert found.p_value < 1e-6
    assert found.found_by == "order"
    assert "misfit" in found.text
    assert "p < 1e-09)" in found.text


def test_structure_far_below_the_noise_is_said_but_is_no_misfit():
    slow = 0.3 * np.sin(np.arange(4000) / 40.0)
    found = outcome_of(slow + np.random.default_rng(3).standard_normal(4000))
    assert found.p_value < 0.01
    assert not found.found
    assert "less than the noise" in found.text


def test_far_more_than_the_noise_is_a_misfit_however_short():
    found = structure_test([np.ones(18)], np.arange(18), np.full(18, 5.0), np.ones(18))
    assert found.p_value == 1.0
    assert found.found
    assert found.found_by == "size"
    assert found.text.endswith("5 times what noise leaves)")


def test_much_more_than_noise_without_anything_slow_does_not_contradict_itself():
    residual = 3.0 * (-1.0) ** np.arange(900)
    found = structure_test([residual], np.arange(900), residual, np.ones(900))
    assert not found.found
    assert found.found_by is None
    assert "more than noise, but little of it is slow" in found.text
    assert "less than the noise" not in found.text
    assert "(nothing slow beside 1 µN of noise" in found.text


def test_samples_on_either_side_of_a_gap_are_no_neighbours():
    rng = np.random.default_rng(4)
    # Every sample repeats the one before: neighbours in the list, but far apart in the record.
    twice = np.repeat(rng.standard_normal(300), 2)
    near, apart = np.arange(600), np.arange(600) * 50
    ones = np.ones(600)
    assert structure_test([twice], near, ones, ones).p_value < 1e-6
    assert structure_test([twice], apart, ones, ones).statistic == 0.0
