"""Small matrices against NumPy, in double precision."""

import numpy as np
import pytest

from nishiki.small_matrices import eigenvalues, factorise, inverse, solve_by_cofactors, substitute


def positive(size, seed, scatter=1.0):
    """A symmetric positive matrix: unit directions added up, as normal equations are."""
    directions = np.array([1.0] + [0.0] * (size - 1)) + scatter * np.random.default_rng(seed).normal(
        size=(4 * size, size)
    )
    return directions.T @ directions


def six(matrix):
    return tuple(matrix[np.triu_indices(3)])


@pytest.mark.parametrize("scatter", [1.0, 1e-2])
def test_three_by_three(scatter):
    for seed in range(20):
        matrix, right = positive(3, seed, scatter), np.random.default_rng(seed).normal(size=3)
        expected = np.linalg.eigvalsh(matrix)
        assert np.allclose(eigenvalues(*six(matrix)), expected[[0, 2]], rtol=0, atol=1e-14 * expected[2])
        condition = expected[2] / expected[0]
        assert np.allclose(inverse(*six(matrix)), six(np.linalg.inv(matrix)), rtol=1e-14 * condition, atol=0)
        *scaled, determinant = solve_by_cofactors(six(matrix), *right)
        assert np.isclose(determinant, np.linalg.det(matrix), rtol=1e-14 * condition**2)
        found = np.array(scaled) / determinant
        assert np.linalg.norm(found - np.linalg.solve(matrix, right)) < 1e-14 * condition**2 * np.linalg.norm(found)


def test_five_by_five():
    for seed in range(20):
        matrix, right = positive(5, seed), np.random.default_rng(seed).normal(size=5)
        below = tuple(matrix[i, j] for i, j in ((2, 1), (3, 1), (4, 1), (3, 2), (4, 2), (4, 3)))
        factors = factorise(tuple(np.diag(matrix)), *matrix[1:, 0], below)
        assert factors.positive
        assert np.allclose(substitute(factors, *right), np.linalg.solve(matrix, right), rtol=1e-10)
        lower = np.eye(5)
        lower[np.tril_indices(5, -1)] = [getattr(factors, f"l{i}{j}") for i in range(5) for j in range(i)]
        diagonal = [1 / getattr(factors, f"i{k}") for k in range(5)]
        assert np.allclose(lower @ np.diag(diagonal) @ lower.T, matrix, rtol=1e-12)
    assert not factorise((1.0, 1.0, 1.0, 1.0, 1.0), 2.0, 0.0, 0.0, 0.0, (0.0,) * 6).positive
