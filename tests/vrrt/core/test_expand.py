"""One iteration on a toy policy, and insertion, against plain loops."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_cases import GOAL, START
from hypothesis import given, settings
from hypothesis import strategies as st

import vrrt_jax
from vrrt_jax.core import tree as trees
from vrrt_jax.core.expand import expand
from vrrt_jax.core.types import Proposals, Rejection, pytree


@pytree
class Scripted:
    """Tries given targets from the root, whatever they are."""

    target: jax.Array
    ok: jax.Array
    edge_steps: int = dataclasses.field(default=8, metadata={"static": True})

    def propose(self, world, goal, tree, key):
        lanes = self.ok.shape[0]
        return Proposals(
            parent=jnp.zeros(lanes, jnp.int32),
            target=self.target,
            valid=self.ok,
            partial=jnp.zeros(lanes, bool),
            aux=None,
        )

    def evaluate(self, world, goal, q, proposals):
        score = jnp.where(q[:, 0] > 0.02, jnp.nan, q[:, 0])
        return score, {"twice": 2 * q}

    def after_insert(self, world, goal, tree, proposals, expansion):
        return tree


def toy_tree(q, capacity):
    payload = {"twice": jnp.asarray(2 * q)[None]}
    return trees.create(jnp.asarray(q)[None], jnp.zeros(1), payload, capacity)


def test_each_rejection_is_counted_once_and_the_rest_is_inserted(wall_world):
    root = START
    lanes = 8
    target = np.tile(root, (lanes, 1))
    target[0, 0] -= 0.05  # fine
    target[1, 1] = np.nan
    target[2] = root  # no step
    target[3, 0] -= 0.05  # not ok
    target[4, 0] -= 0.1  # fine
    target[5, 0] = -9.0  # clipped to the edge's length, fine
    target[6, 0] += 0.1  # fine
    target[7, 0] += 0.02  # fine
    policy = Scripted(target=jnp.asarray(target), ok=jnp.arange(lanes) != 3)
    tree = jax.jit(expand)(wall_world, None, policy, toy_tree(root, 5), jax.random.key(0))
    rejected = dict(zip(Rejection, np.asarray(tree.rejected), strict=True))
    assert rejected == {
        Rejection.NO_PARENT: 1,
        Rejection.LIMITS: 1,
        Rejection.BLOCKED: 0,
        Rejection.NOT_FINITE: 1,
        Rejection.CAPACITY: 1,
    }
    assert int(tree.size) == 5 and int(tree.iteration) == 1
    inserted = [target[0], target[4], root - np.eye(7)[0] * 8 * 0.02, target[6]]
    np.testing.assert_allclose(tree.q[1:], inserted, atol=1e-6)
    np.testing.assert_allclose(tree.payload["twice"], 2 * np.asarray(tree.q), atol=1e-6)
    np.testing.assert_allclose(
        tree.cost, np.linalg.norm(np.asarray(tree.q) - root, axis=1), atol=1e-6
    )
    np.testing.assert_array_equal(tree.parent, [-1, 0, 0, 0, 0])


def test_nan_scores_and_blocked_edges_stay_out(wall_world):
    inside = GOAL.copy()
    inside[0] = 0.03  # beside the wall's middle: in collision
    target = np.stack([inside, START - 0.01])
    near = START.copy()
    near[0] = -0.12
    policy = Scripted(target=jnp.asarray(target), ok=jnp.ones(2, bool))
    free_here = jax.jit(vrrt_jax.is_free)
    assert not bool(free_here(wall_world, jnp.asarray(inside)))
    tree = toy_tree(START, 8)
    grown = jax.jit(expand)(wall_world, None, policy, tree, jax.random.key(0))
    assert int(grown.size) == 3  # both steps are clipped well before the wall
    q = START.copy()
    q[0] = -0.3
    while bool(free_here(wall_world, jnp.asarray(q))):
        q[0] += 0.01
    q[0] -= 0.01
    blocked = jax.jit(expand)(wall_world, None, policy, toy_tree(q, 8), jax.random.key(0))
    assert int(blocked.rejected[Rejection.BLOCKED]) >= 1


@settings(deadline=None, max_examples=25, derandomize=True)
@given(st.lists(st.booleans(), min_size=6, max_size=6), st.integers(1, 9))
def test_insertion_equals_a_loop(ok, capacity):
    tree = toy_tree(np.zeros(7, np.float32), capacity)
    q = np.arange(42, dtype=np.float32).reshape(6, 7)
    grown, slot = trees.insert(
        tree,
        q=jnp.asarray(q),
        parent=jnp.zeros(6, jnp.int32),
        cost=jnp.arange(6.0),
        score=jnp.arange(6.0),
        payload={"twice": jnp.asarray(2 * q)},
        valid=jnp.asarray(ok),
    )
    expected, slots = [np.zeros(7, np.float32)], []
    for row, wanted in zip(q, ok, strict=True):
        fits = wanted and len(expected) < capacity
        slots.append(len(expected) if fits else capacity)
        if fits:
            expected.append(row)
    np.testing.assert_array_equal(slot, slots)
    assert int(grown.size) == len(expected)
    np.testing.assert_array_equal(grown.q[: len(expected)], expected)
    assert np.all(np.isinf(grown.score[len(expected) :]))


@pytest.mark.parametrize("size", [1, 511, 512, 700, 1300])
def test_nearest_nodes_are_found_block_by_block(wall_world, rng, size):
    capacity, aim = 1300, rng.uniform(-2, 2, (5, 7)).astype(np.float32)
    nodes = rng.uniform(-2, 2, (size, 7)).astype(np.float32)
    tree = trees.create(nodes, np.zeros(size), None, capacity)
    label = jnp.asarray(rng.integers(0, 2, capacity))
    wanted = jnp.array([0, 1, 0, 1, 7])
    apart = np.linalg.norm(nodes - aim[:, None], axis=2)
    np.testing.assert_array_equal(
        jax.jit(trees.nearest)(wall_world, tree, aim), apart.argmin(axis=1)
    )
    apart[np.asarray(label)[:size] != np.asarray(wanted)[:, None]] = np.inf
    np.testing.assert_array_equal(
        jax.jit(trees.nearest)(wall_world, tree, aim, label, wanted), apart.argmin(axis=1)
    )
