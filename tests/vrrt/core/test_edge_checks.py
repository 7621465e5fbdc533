"""Checks of edges: free prefixes, whole edges, the first free one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_cases import GOAL, START

from vrrt_jax.core.edge_checks import first_free_edge, free_prefix, is_edge_free
from vrrt_jax.scene.closed_form import ClosedFormWorld


def test_free_steps_counts_the_leading_free_ones(wall_world, free):
    points = START + np.linspace(0, 1, 65)[1:, None] * (GOAL - START)
    is_free = np.asarray(free(wall_world, points.astype(np.float32)))
    assert not is_free.all() and is_free[0]
    start, goal = jnp.asarray(START)[None], jnp.asarray(GOAL)[None]
    edge = wall_world.edge(start, goal)
    count, _ = jax.jit(free_prefix, static_argnums=3)(wall_world, start, edge, 64)
    assert int(count[0]) == int(np.argmin(is_free))


class Counted(ClosedFormWorld):
    """An ``is_free`` of one's own, so that no distance vouches for what was not looked at."""

    def is_free(self, q):
        return super().is_free(q)


@pytest.mark.parametrize("kind", [ClosedFormWorld, Counted])
@pytest.mark.parametrize(
    ("num_steps", "length"), [(6, 0.12), (37, 0.7), (96, 3.0), (64, 0.3), (50, 0.3)]
)
def test_few_checks_find_what_all_find(wall_world, free, rng, kind, num_steps, length):
    world, step = kind(**vars(wall_world)), rng.normal(size=(40, 7))
    edge = (length * step / np.linalg.norm(step, axis=1, keepdims=True)).astype(np.float32)
    start = rng.uniform(wall_world.lower, wall_world.upper, (4000, 7)).astype(np.float32)
    start = start[np.asarray(free(wall_world, start))][:40]
    points = start[:, None] + edge[:, None] * np.arange(1, num_steps + 1)[:, None] / num_steps
    is_free = np.asarray(free(wall_world, points.reshape(-1, 7).astype(np.float32)))
    # Of sub-steps that are finer than the resolution, every second, third, ... is checked.
    stride = max(1, int(num_steps * float(world.resolution) / length))
    asked = (np.arange(num_steps) + 1) % stride == 0
    asked[-1] = True
    is_free = is_free.reshape(40, num_steps) | ~asked
    whole = is_free.all(axis=1)
    assert 2 < whole.sum() < 40

    @jax.jit
    def ask(world, start, edge, tried):
        return (
            free_prefix(world, start, edge, num_steps),
            is_edge_free(world, start, edge, num_steps),
            first_free_edge(world, start, edge, num_steps, tried)[0],
        )

    ends_free = is_free[:, -1]
    (prefix, checked), (free_whole, checked_whole), first = ask(world, start, edge, ends_free)
    # At least one check for each edge, unless distances vouch; never one twice.
    assert 40 <= int(checked_whole) <= int(checked) <= 40 * asked.sum()
    first_blocked = np.cumprod(is_free, axis=1).sum(axis=1)
    expected = np.where(whole, num_steps, first_blocked // stride * stride)
    np.testing.assert_array_equal(prefix, expected)
    np.testing.assert_array_equal(free_whole, whole)
    assert int(first) == int(np.argmax(whole))
    assert int(ask(world, start, edge, ends_free & ~whole)[2]) == 40


def test_edges_without_length_take_one_check_and_those_without_numbers_are_blocked(wall_world):
    world, start = Counted(**vars(wall_world)), jnp.asarray(START)
    edge = jnp.stack([jnp.zeros(7), jnp.full(7, jnp.nan)])
    ask = jax.jit(free_prefix, static_argnums=3)
    count, _ = ask(world, jnp.stack([start, start]), edge, 64)
    assert count.tolist() == [64, 0]
    assert int(ask(world, jnp.stack([start, start]), jnp.zeros((2, 7)), 64)[1]) == 2


def test_slack_spares_the_checks_next_to_what_blocks_an_edge(wall_world):
    """The prefix ends up to so many sub-steps earlier; edges that are free are found free."""
    world, start = Counted(**vars(wall_world)), jnp.asarray(START)
    share = jnp.append(jnp.linspace(0.8, 1.0, 15), 0.05)[:, None]
    edge = wall_world.edge(start, jnp.asarray(GOAL)) * share
    ask = jax.jit(free_prefix, static_argnums=(3, 6))
    starts = jnp.tile(start, (16, 1))
    exact, all_checks = ask(world, starts, edge, 64, True, True, 0)
    early, few_checks = ask(world, starts, edge, 64, True, True, 3)
    less = np.asarray(exact - early)
    assert np.all(np.asarray(exact)[:15] < 64) and int(exact[15]) == int(early[15]) == 64
    assert np.all((less >= 0) & (less <= 3)) and less.any()
    assert int(few_checks) <= int(all_checks) - 15
