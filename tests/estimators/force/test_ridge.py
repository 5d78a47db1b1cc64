import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from microdrivers.core.errors import DataError, IllConditioned, OutOfRange
from microdrivers.estimators.force.ridge import ridge_fit


def regressors(seed: int, samples: int = 80) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = np.linspace(1.0, 120.0, samples)
    columns = np.column_stack([rng.normal(0.0, 10.0, samples), rng.normal(5.0, 1.0, samples), x, x**3])
    return columns, columns @ np.array([1e-3, 27.7, 4.5, 1e-4]) + rng.normal(0.0, 0.5, samples)


def test_it_is_eq_25_in_columns_scaled_to_a_mean_square_of_one():
    columns, force = regressors(1)
    scale = np.sqrt(np.mean(columns**2, axis=0))
    phi = (columns / scale).T
    expected = np.linalg.solve(phi @ phi.T + 0.02 * 80 * np.eye(4), phi @ force) / scale
    assert np.allclose(ridge_fit(columns, force, ridge=0.02).theta, expected, rtol=1e-10)


@given(st.integers(0, 1000), st.lists(st.sampled_from([1e-9, 1e-3, 1.0, 1e6]), min_size=4, max_size=4))
def test_units_of_the_columns_do_not_change_the_fit(seed, units):
    columns, force = regressors(seed)
    one, other = ridge_fit(columns, force, ridge=1e-3), ridge_fit(columns * units, force, ridge=1e-3)
    assert np.allclose(other.theta * units, one.theta, rtol=1e-6)
    assert np.allclose(other.residual_uN, one.residual_uN, atol=1e-6)
    assert other.condition_number == pytest.approx(one.condition_number, rel=1e-6)


def test_the_ridge_pulls_towards_zero_and_a_small_one_does_not_matter():
    columns, force = regressors(2)
    free, pulled = ridge_fit(columns, force, ridge=0.0), ridge_fit(columns, force, ridge=1.0)
    assert np.allclose(ridge_fit(columns, force).theta, free.theta, rtol=1e-3)
    assert np.linalg.norm(columns @ pulled.theta) < np.linalg.norm(columns @ free.theta)


def test_the_covariance_is_that_of_repeated_noise():
    columns, _ = regressors(3)
    rng, truth = np.random.default_rng(4), np.array([1e-3, 27.7, 4.5, 1e-4])
    fits = [ridge_fit(columns, columns @ truth + rng.normal(0.0, 0.5, len(columns))) for _ in range(300)]
    spread = np.std([fit.theta for fit in fits], axis=0)
    stated = np.mean([np.sqrt(np.diag(fit.covariance)) for fit in fits], axis=0)
    assert np.allclose(spread, stated, rtol=0.15)


def test_a_column_without_information_gets_nothing():
    columns, force = regressors(5)
    columns[:, 0] = 0.0
    fit = ridge_fit(columns, force)
    assert fit.theta[0] == 0.0
    assert fit.condition_number == np.inf
    with pytest.raises(IllConditioned, match="dependent"):
        ridge_fit(columns, force, ridge=0.0)


@pytest.mark.parametrize(
    ("columns", "force"),
    [
        (np.ones((3, 4)), np.ones(3)),
        (np.ones((9, 4)), np.ones(8)),
        (np.full((9, 4), np.nan), np.ones(9)),
        (np.ones((9, 0)), np.ones(9)),
        (np.ones((9, 1)), np.ones(9, dtype=complex)),
        (np.ones((9, 1)), np.ma.masked_array(np.ones(9), mask=np.arange(9) == 3)),
        (np.float64(1.0), np.ones(9)),
        ([["a"]], [1.0]),
        ([[1.0], [1.0, 2.0]], [1.0, 1.0]),
    ],
)
def test_what_cannot_be_fitted_is_refused(columns, force):
    with pytest.raises(DataError):
        ridge_fit(columns, force)


@pytest.mark.parametrize("ridge", [-1.0, np.nan, np.inf])
def test_a_ridge_that_is_none_is_refused(ridge):
    with pytest.raises(OutOfRange, match="the ridge is"):
        ridge_fit(*regressors(1), ridge=ridge)


def test_as_many_samples_as_columns_leave_nothing_to_tell_the_noise_by():
    fit = ridge_fit(np.eye(3), np.ones(3))
    assert np.allclose(fit.theta, 1.0)
    assert fit.degrees_of_freedom == 0
    assert np.isnan(fit.covariance).all()
    assert np.isfinite(ridge_fit(np.eye(3)[:, :2], np.ones(3)).covariance).all()


def test_lists_are_taken_as_arrays():
    columns, force = regressors(6)
    assert np.array_equal(ridge_fit(columns.tolist(), force.tolist()).theta, ridge_fit(columns, force).theta)


@pytest.mark.filterwarnings("ignore:the matrix subclass:PendingDeprecationWarning")
def test_a_matrix_is_taken_as_an_array():
    columns, force = regressors(6)
    assert np.array_equal(ridge_fit(np.matrix(columns), force).theta, ridge_fit(columns, force).theta)
