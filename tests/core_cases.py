"""A wall between a start and a goal of the Panda, for tests of the kernel."""

import jax
import numpy as np

from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.search import make_termination, search

# Either side of the wall; the straight line between them goes through it.
START = np.array([-0.9, 0.5, 0.0, -1.6, 0.0, 2.0, 0.8], np.float32)
GOAL = np.array([0.9, 0.5, 0.0, -1.6, 0.0, 2.0, 0.8], np.float32)


def connect(wall_world, seed, **termination):
    goal, policy = ConfigurationGoal(q=GOAL), RRTConnect()
    return search(
        wall_world,
        goal,
        policy,
        policy.init(wall_world, goal, START[None], 4096),
        key=jax.random.key(seed),
        termination=make_termination(0.0, **{"max_iterations": 200, **termination}),
    )


def assert_free(world, free, path):
    dense = np.concatenate(
        [
            a + np.linspace(0, 1, 200)[:, None] * (b - a)
            for a, b in zip(path[:-1], path[1:], strict=True)
        ]
    )
    assert np.mean(np.asarray(free(world, dense.astype(np.float32)))) > 0.995
