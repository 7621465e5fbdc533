"""FIRE's sampler: experiences that are like what is at hand, retrieved once for a query.

Of each part of the home, those entries of the database are taken that the network puts near it,
with the query as seen from there. Their samples, each with a Gaussian around it, are a mixture
that the planner draws from (Chamzas et al. 2022). Letters: ``K`` components, ``D`` joints.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.learning.experience_database import Database
from nrp_jax.learning.models import FIRE, ModelConfig
from nrp_jax.learning.primitives import (
    cells_of_parts,
    corners_of_parts,
    middles,
    query_features,
)
from nrp_jax.learning.similarity import MARGIN, encode_parts
from nrp_jax.scene.grid_world import GridWorld
from nrp_jax.scene.near_cells import occupied_cells
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import corner_of
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree

SIGMA = 0.2  # standard deviation of every joint around a sample [m] and [rad]
UNIFORM_SHARE = 0.2  # of the samples of planners that draw from a mixture
MOST = 1 << 14  # components; of more, so many at random


@pytree
class Mixture:
    """A mixture of Gaussians with equal weights; uniform if it has no component."""

    means: jax.Array  # (K, D), rows beyond ``num`` are padding
    num: jax.Array  # () i32
    sigma: jax.Array  # () [m] and [rad]

    def draw(
        self, world: GridWorld, q_start: jax.Array, q_goal: jax.Array, num: int, key: jax.Array
    ) -> jax.Array:
        """Configurations (num, D) inside the limits; see :class:`GlobalCVAESampler`."""
        key_component, key_noise, key_uniform = jax.random.split(key, 3)
        component = jax.random.randint(key_component, (num,), 0, jnp.maximum(self.num, 1))
        noise = self.sigma * jax.random.normal(key_noise, (num, self.means.shape[1]))
        q = enforce_bounds(world, self.means[component] + noise)
        return jnp.where(self.num > 0, q, sample_configurations(world, key_uniform, num))


class ExperienceSampler:
    """A database of experiences, which makes a mixture for each query."""

    def __init__(
        self,
        robot: MobileRobot,
        database: Database,
        sigma: float = SIGMA,
        distance: float = MARGIN,
    ):
        """Take a database of this robot.

        Args:
            robot: to plan for.
            database: of this robot.
            sigma: standard deviation around a sample [m] and [rad].
            distance: of latents, within which an entry is taken.
        """
        self.robot, self.database, self.sigma, self.distance = robot, database, sigma, distance
        self.config = ModelConfig(task=database.task, kind=FIRE)

    @single_precision
    def retrieve(
        self, world: GridWorld, q_start: np.ndarray, q_goal: np.ndarray, seed: int = 0
    ) -> Mixture:
        """Retrieve the experiences that are like a query in a home.

        Args:
            world: the robot in the home.
            q_start: (D,) where the query begins.
            q_goal: (D,) where it ends.
            seed: of the choice among too many.
        """
        resolution = float(world.near[0].cell)
        cells = cells_of_parts(occupied_cells(world.near[0]))
        corners = corners_of_parts(cells.shape)
        middle = middles(corners, resolution) + corner_of(world)
        shift = np.pad(middle, [(0, 0), (0, self.robot.num_joints - 2)])
        seen = query_features(self.robot, q_start - shift, q_goal - shift)
        home = np.zeros(len(corners), np.int32)
        latents = encode_parts(
            self.database.variables, jnp.asarray(cells[None]), home, corners, seen
        )
        part, entry = _near(latents, self.database.latents, self.distance)
        if len(part) > MOST:
            kept = np.random.default_rng(seed).choice(len(part), MOST, replace=False)
            part, entry = part[kept], entry[kept]
        means = self.database.samples[entry] + shift[part]
        room = 1 << max(len(means) - 1, 0).bit_length()  # few sizes, so few compilations
        padded = np.zeros((max(room, 64), self.robot.num_joints), np.float32)
        padded[: len(means)] = means
        return Mixture(
            means=jnp.asarray(padded),
            num=jnp.int32(len(means)),
            sigma=jnp.float32(self.sigma),
        )


def _near(
    latents: np.ndarray, others: np.ndarray, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Indices (k,) and (k,) of latents and others that are nearer than a distance."""
    # |a - b|^2 < d^2 is a b - |b|^2 / 2 > (|a|^2 - d^2) / 2.
    found: list[Any] = []
    halves = np.sum(others**2, axis=1) / 2
    for first in range(0, len(latents), 64):
        some = latents[first : first + 64]
        close = some @ others.T
        close -= halves
        row, entry = np.nonzero(close > (np.sum(some**2, axis=1)[:, None] - distance**2) / 2)
        found.append((row + first, entry))
    part, entry = (np.concatenate(column) for column in zip(*found, strict=True))
    return part, entry
