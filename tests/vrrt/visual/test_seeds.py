"""Seeds: free, near the start, and more like the goal than chance."""

import jax
import numpy as np
from pictures import Q_START, QUICK

from vrrt_jax import ImageGoal, VisualRRT
from vrrt_jax.core.tree import UNREACHED
from vrrt_jax.visual.problem import make_problem
from vrrt_jax.visual.seeds import seeded_roots


def test_seeds_are_free_near_and_look_alike_and_evolve(
    panda, self_model, camera, image, wall_world, free
):
    goal = ImageGoal(self_model, camera, image)

    def seeds(rounds):
        config = QUICK.changed({"seeds.steps": 0, "seeds.rounds": rounds})
        problem = make_problem(panda, goal, Q_START, config)
        q_roots = seeded_roots(wall_world, problem.seeds, Q_START[None], jax.random.key(0))
        policy = VisualRRT.from_config(config, wall_world)
        tree = policy.init(wall_world, problem.goal, q_roots, config.tree.capacity)
        assert np.all(np.asarray(tree.cost[1:64]) == UNREACHED) and float(tree.cost[0]) == 0
        roots = np.asarray(tree.q[1 : int(tree.size)])
        assert len(roots) == 63
        assert np.all(np.asarray(free(wall_world, roots)))
        return roots, problem.seeds.goal

    first, coarse = seeds(rounds=0)
    evolved, _ = seeds(rounds=3)
    assert np.linalg.norm(first - Q_START, axis=1).max() <= 2.8 + 1e-4
    others = panda.lower + np.random.default_rng(0).random((64, 7)) * (panda.upper - panda.lower)
    loss = jax.jit(jax.vmap(lambda q: coarse.loss(wall_world, q)))
    assert np.median(loss(first)) < np.median(loss(others.astype(np.float32)))
    assert np.mean(loss(evolved)) < 0.9 * np.mean(loss(first))
