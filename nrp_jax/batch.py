"""Many plans at once, on as many threads as there are cores."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.planner import check_inputs, plan
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import build_world
from vrrt_jax.core.command import usable_cores
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import PlanResult


@single_precision
def plan_batch(
    robot: MobileRobot,
    grid: Grid | Sequence[Grid],
    q_starts: np.ndarray,
    q_goals: np.ndarray,
    *,
    key: jax.Array,
    **options: Any,
) -> list[PlanResult]:
    """Solve Q problems of one robot at once; problem ``i`` uses the key ``fold_in(key, i)``.

    A search keeps one core busy, so that threads do more on a CPU than an outer ``vmap``, each of
    whose steps waits for the problem that needs most. Plans are those of Q calls of
    :func:`nrp_jax.plan`.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: the home of all problems, or Q of them.
        q_starts: (Q, D) configurations [m] and [rad].
        q_goals: (Q, D) configurations.
        key: random key.
        options: what :func:`nrp_jax.plan` takes besides, such as ``method="rrt-connect"``; but for
            ``world`` and ``scene``.

    Raises:
        ValueError: an input makes no sense; the message names the problem.
    """
    num = len(q_starts)
    grids = [grid] * num if isinstance(grid, Grid) else list(grid)
    if num == 0 or not num == len(q_goals) == len(grids):
        raise ValueError(
            f"got {num} starts, {len(q_goals)} goals and {len(grids)} homes; expected as many, and "
            "one at least"
        )
    # Each home is built once.
    homes = {id(own): (build_world(robot, own), ExactScene(robot, own)) for own in grids}
    for i, own in enumerate(grids):
        try:
            check_inputs(robot, homes[id(own)][0], q_starts[i], q_goals[i])
        except ValueError as error:
            raise ValueError(f"problem {i}: {error}") from None
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num))

    def plan_one(i: int) -> PlanResult:
        world, scene = homes[id(grids[i])]
        problem = robot, grids[i], q_starts[i], q_goals[i]
        return plan(*problem, key=keys[i], world=world, scene=scene, **options)

    with interruptible(), ThreadPoolExecutor(usable_cores()) as pool:
        # The first problem compiles what the others use. Ctrl-C ends all, each with its best path.
        return [plan_one(0), *pool.map(plan_one, range(1, num))]
