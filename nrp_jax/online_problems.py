"""The problems that NEXT's own planner tries while it is trained, and the paths that it finds.

Letters: ``K`` states of a path, ``D`` joints.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.config import PlannerConfig
from nrp_jax.learning.checkpoint import Model
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.difficulty import long_queries
from nrp_jax.learning.models import NEXT
from nrp_jax.learning.next_rows import even_states
from nrp_jax.learning.recipe import OnlineConfig
from nrp_jax.planners.by_name import policy_of
from nrp_jax.samplers import make_sampler
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import build_world
from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.files import replacing
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.interrupt import uninterrupted
from vrrt_jax.core.search import COST, make_termination, search


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundPaths:
    """The paths that a round found."""

    home: np.ndarray  # (n,)
    q: np.ndarray  # (n, K, D)
    length: np.ndarray  # (n,) [m]
    tried: int  # problems up to the end of the round


class Problems:
    """Long queries in the training homes, and the planner that tries them."""

    def __init__(
        self, robot: MobileRobot, dataset: Dataset, homes: np.ndarray, settings: OnlineConfig
    ):
        """Take these homes of a data set in turn; nothing is drawn before it is needed."""
        self.robot, self.dataset, self.homes, self.settings = robot, dataset, homes, settings
        self._drawn: dict[int, Any] = {}

    def solve(self, file: Path, first: int, model: Model) -> FoundPaths:
        """Try problems from ``first`` on, until their paths have enough states.

        If the file is there, it is read instead.
        """
        settings = self.settings
        num_states = self.dataset.settings.waypoints + 2
        if file.exists():
            arrays: dict[str, Any] = read_arrays(file, "home", "q", "length", "tried")
            arrays["tried"] = int(arrays["tried"])
            return FoundPaths(**arrays)
        homes, paths, lengths, problem = [], [], [], first
        while problem < settings.problems and len(paths) * (num_states - 1) < settings.states:
            home, world, path = self._solved(problem, model)
            problem += 1
            if path is not None:
                states, length = even_states(world, path, num_states)
                for column, value in zip(
                    (homes, paths, lengths), (home, states, length), strict=True
                ):
                    column.append(value)
        found = FoundPaths(
            home=np.array(homes, np.int32),
            q=np.array(paths, np.float32).reshape(-1, num_states, self.robot.num_joints),
            length=np.array(lengths, np.float32),
            tried=problem,
        )
        with replacing(file) as handle:
            np.savez_compressed(handle, **vars(found))
        return found

    def _solved(self, problem: int, model: Model) -> tuple[int, Any, np.ndarray | None]:
        """The home of a problem, its world, and the path (P, D) that was found, if any."""
        settings, robot = self.settings, self.robot
        home = int(self.homes[problem % len(self.homes)])
        world, starts, goals = self._of_home(home)
        start, goal = (q[problem // len(self.homes)] for q in (starts, goals))
        key = jax.random.fold_in(jax.random.key(settings.seed), problem)
        planner = PlannerConfig(goal_bias=0.1, lanes=settings.lanes)
        policy: Any = policy_of(NEXT, robot, world, make_sampler(model), planner, (start, goal))
        share = jnp.float32(settings.explored_in(problem))
        policy = dataclasses.replace(policy, explored_share=share)
        target = ConfigurationGoal(q=jnp.asarray(goal))
        iterations = -(-settings.expansions // settings.lanes)
        room = 1 << (iterations * settings.lanes + 1).bit_length()
        tree = policy.init(world, target, start[None], room)
        rule = make_termination(policy.goal_score(target), max_iterations=iterations)
        with uninterrupted():
            found = search(world, target, policy, tree, key=key, termination=rule)
        if not np.isfinite(found.history[-1, COST]):
            return home, world, None
        return home, world, policy.extract_path(found.tree)

    def _of_home(self, home: int) -> tuple[Any, np.ndarray, np.ndarray]:
        """A home's world, with checks as fine as such a planner's, and all its starts and goals."""
        if home not in self._drawn:
            grid = self.dataset.grids[home]
            grid = grid.flatten() if self.robot.planar else grid
            world = build_world(self.robot, grid)
            num = -(-self.settings.problems // len(self.homes))
            ends = long_queries(self.robot, world, grid, num, self.settings.seed)
            world = dataclasses.replace(world, resolution=world.resolution / 2)
            self._drawn[home] = (world, *ends)
        return self._drawn[home]
