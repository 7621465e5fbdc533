"""The published Visual-RRT on the kernel: the frontier's law, Adam, exploration, costs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pictures import Q_START

from vrrt_jax import ImageGoal, PlannerConfig, VisualRRT
from vrrt_jax.core.expand import expand
from vrrt_jax.core.rewire import with_costs
from vrrt_jax.core.tree import lineage

pytestmark = pytest.mark.light_compilation

CONFIG = PlannerConfig.paper()


@pytest.fixture(scope="module")
def goal(panda, self_model, camera, image):
    return ImageGoal(self_model, camera, image).at(panda, CONFIG.tree.image_px)


def grown(world, goal, iterations, *, rewiring=True, **numbers):
    """A tree after some iterations; of two programs, whatever the numbers are."""
    changes = {name: jnp.asarray(number) for name, number in numbers.items()}
    policy = VisualRRT.from_config(CONFIG, world)
    policy = dataclasses.replace(policy, rewiring=rewiring, **changes)
    tree = policy.init(world, goal, Q_START[None], 1024)
    step = jax.jit(expand)
    for _ in range(iterations):
        tree = step(world, goal, policy, tree, jax.random.key(0))
    return tree


def test_frontier_law():
    for m, eta, kappa in ((1, 0.7, 0.9), (40, 1.0, 0.9), (40, 0.4, 0.5)):
        visual = VisualRRT(eta=jnp.float32(eta), kappa=jnp.float32(kappa), lanes=1)
        order = jax.random.permutation(jax.random.key(1), 64)
        score, allowed = jnp.argsort(order).astype(jnp.float32), jnp.zeros(64, bool)
        allowed = allowed.at[order[:m]].set(True)
        keys = jax.random.split(jax.random.key(0), 20_000)
        node, ok = jax.vmap(lambda key: visual._draw(score, allowed, key))(keys)  # noqa: B023
        assert bool(jnp.all(ok))
        rank = np.asarray(score, int)[np.asarray(node[:, 0])]
        share = np.bincount(rank, minlength=64) / len(keys)
        k = np.arange(m)
        law = eta * (1 - kappa) * kappa**k / (1 - kappa**m) + (1 - eta) / m
        assert law.sum() == pytest.approx(1)
        np.testing.assert_allclose(share[:m], law, atol=0.012)
        assert share[m:].sum() == 0


def test_draws_are_distinct_and_reported_when_they_run_out():
    visual = VisualRRT()
    node, ok = visual._draw(jnp.zeros(64), jnp.arange(64) < 5, jax.random.key(0))
    assert int(ok.sum()) == 5
    assert sorted(np.asarray(node)[np.asarray(ok)]) == [0, 1, 2, 3, 4]


def test_a_branch_without_exploration_is_plain_adam(goal, open_world):
    tree = grown(
        open_world,
        goal,
        6,
        exploration=0.0,
        kappa=0.0,
        eta=1.0,
        rewiring=False,
    )
    adam = optax.scale_by_adam(b1=0.9, b2=0.9)
    gradient = jax.jit(jax.grad(lambda q: goal.loss(open_world, q)))
    q, state = jnp.asarray(Q_START), adam.init(jnp.asarray(Q_START))
    chain = [q]
    for _ in range(6):
        direction, state = adam.update(gradient(q), state)
        q = q - 0.04 * direction
        chain.append(q)
    exploited = [int(np.argmax(np.asarray(tree.payload.adam.count[: int(tree.size)])))]
    nodes = lineage(tree, exploited[0])
    count = np.asarray(tree.payload.adam.count)[nodes]
    np.testing.assert_array_equal(count, np.arange(len(nodes)))
    np.testing.assert_allclose(np.asarray(tree.q)[nodes], chain[: len(nodes)], atol=2e-3)
    assert len(nodes) >= 4


@pytest.mark.parametrize("rho, longest, median", [(0.7, 0.7, 0.37), (0.0, 0.04, 0.04)])
def test_explored_children_start_fresh_and_step_up_to_rho(goal, open_world, rho, longest, median):
    tree = grown(open_world, goal, 4, exploration=1.0, rho=rho, rewiring=False)
    size = int(tree.size)
    assert size > 1 + 3 * CONFIG.tree.lanes
    assert np.all(np.asarray(tree.payload.adam.count[:size]) == 0)
    assert np.all(np.asarray(tree.payload.adam.mu[:size]) == 0)
    step = np.linalg.norm(tree.q[1:size] - tree.q[tree.parent[1:size]], axis=1)
    assert np.all(step < longest + 1e-5) and abs(np.median(step) - median) < 0.2 * median
    assert not np.any(tree.payload.exploited)


def test_stored_gradients_are_those_of_the_loss(goal, open_world):
    tree = grown(open_world, goal, 3, rewiring=False)
    size = int(tree.size)
    expected = jax.jit(jax.vmap(jax.grad(lambda q: goal.loss(open_world, q))))(tree.q[:size])
    np.testing.assert_allclose(tree.payload.grad[:size], expected, rtol=2e-3, atol=1e-5)


def test_costs_stay_right_under_rewiring(goal, open_world):
    tree = grown(open_world, goal, 12)
    np.testing.assert_allclose(with_costs(open_world, tree).cost, tree.cost, atol=2e-4)
