"""Anderson acceleration: against the solutions of linear systems, and against a plain version."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from epo_lightning.solvers.feedback.anderson import Anderson, least_squares

EVERY = torch.arange(3)


def affine_iterations(size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Matrices and vectors of three iterations u <- M u + c, and the points at which they end."""
    generator = torch.Generator().manual_seed(size)
    matrix = torch.randn(3, size, size, generator=generator, dtype=torch.double)
    vector = torch.randn(3, size, generator=generator, dtype=torch.double)
    end = torch.linalg.solve(torch.eye(size, dtype=torch.double) - matrix, vector)
    return matrix, vector, end


@given(size=st.integers(1, 5))
def test_affine_iterations_end_after_as_many_points_as_they_have_dimensions(size: int) -> None:
    """Also those that would diverge without acceleration."""
    matrix, vector, end = affine_iterations(size)
    memory, points = Anderson(3, size, size), torch.zeros_like(end)
    for _ in range(size + 1):
        deviations = (matrix @ points[..., None])[..., 0] + vector - points
        new = memory.next(EVERY, points, deviations)
        memory.remember(EVERY, points, deviations)
        points = new
    torch.testing.assert_close(points, end, rtol=1e-6, atol=1e-6)


def test_the_next_point_is_that_of_a_plain_version() -> None:
    rng = np.random.default_rng(0)
    memory, seen = Anderson(3, 2, 6), []
    for _ in range(4):
        points, deviations = rng.normal(size=(2, 3, 6))
        found = memory.next(EVERY, torch.from_numpy(points), torch.from_numpy(deviations))
        memory.remember(EVERY, torch.from_numpy(points), torch.from_numpy(deviations))
        for s in range(3):
            wanted = points[s] + deviations[s]
            if seen:
                by_deviations = np.stack([deviations[s] - f[s] for _, f in seen], 1)
                by_points = np.stack([points[s] - u[s] for u, _ in seen], 1)
                wanted -= (by_points + by_deviations) @ np.linalg.lstsq(by_deviations, deviations[s], rcond=None)[0]
            np.testing.assert_allclose(found[s].numpy(), wanted, atol=1e-10)
        seen = [*seen, (points, deviations)][-2:]


def test_an_iteration_that_begins_anew_takes_the_plain_step() -> None:
    memory = Anderson(3, 2, 4)
    points, deviations = torch.randn(2, 3, 4, dtype=torch.double)
    memory.remember(EVERY, 2 * points, 3 * deviations)
    memory.forget(torch.tensor([1]))
    found = memory.next(EVERY, points, deviations)
    torch.testing.assert_close(found[1], (points + deviations)[1])
    assert not torch.isclose(found[[0, 2]], (points + deviations)[[0, 2]]).any()


def test_some_iterations_do_not_change_the_others() -> None:
    points, deviations, older, before = torch.randn(4, 3, 4, dtype=torch.double)
    together, apart = Anderson(3, 2, 4), Anderson(3, 2, 4)
    together.remember(EVERY, older, before)
    for row in ([2], [0, 1]):
        apart.remember(torch.tensor(row), older[row], before[row])
    wanted = together.next(EVERY, points, deviations)
    torch.testing.assert_close(apart.next(torch.tensor([1]), points[[1]], deviations[[1]]), wanted[[1]])


def test_points_that_repeat_are_no_trouble() -> None:
    memory = Anderson(3, 2, 4)
    points, deviations = torch.randn(2, 3, 4, dtype=torch.double)
    memory.remember(EVERY, points, deviations)
    memory.remember(EVERY, points, deviations)
    torch.testing.assert_close(memory.next(EVERY, points, deviations), points + deviations)


@given(rows=st.integers(1, 3), length=st.integers(1, 8), count=st.integers(1, 6), seed=st.integers(0, 9))
def test_least_squares_are_those_of_numpy(rows: int, length: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns, wanted = rng.normal(size=(rows, length, count)), rng.normal(size=(rows, length))
    found = least_squares(torch.from_numpy(columns), torch.from_numpy(wanted)).numpy()
    for row in range(rows):
        best = np.linalg.lstsq(columns[row], wanted[row], rcond=None)[0]
        np.testing.assert_allclose(columns[row] @ found[row], columns[row] @ best, atol=1e-8)


def test_a_column_that_depends_on_others_has_no_share() -> None:
    column, other = torch.tensor([[1.0, 2.0, 0.0], [1.0, 0.0, 1.0]], dtype=torch.double)
    columns = torch.stack((column, 3 * column, torch.zeros_like(column), other), -1)[None]
    wanted = torch.tensor([1.0, 3.0, 7.0], dtype=torch.double)
    first, last = np.linalg.lstsq(columns[0][:, [0, 3]].numpy(), wanted.numpy(), rcond=None)[0]
    found = least_squares(columns, wanted[None])
    torch.testing.assert_close(found, torch.tensor([[first, 0.0, 0.0, last]], dtype=torch.double))


def test_rows_that_are_not_finite_do_not_change_the_others() -> None:
    torch.manual_seed(0)
    columns, wanted = torch.randn(3, 6, 2, dtype=torch.double), torch.randn(3, 6, dtype=torch.double)
    sound = least_squares(columns, wanted)
    wanted[1, 2], columns[2, 0, 1] = torch.nan, torch.inf
    found = least_squares(columns, wanted)
    assert torch.equal(found[0], sound[0])
    assert not found[1:].isfinite().all(-1).any()
