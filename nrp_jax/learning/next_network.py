"""NEXT's network: it plans on a small picture of the map, and reads the plan where a robot stands.

After Chen, Dai, Lin, Ye, Liu and Song, "Learning to Plan in High Dimensions via Neural
Exploration-Exploitation Trees" (ICLR 2020). Letters: ``n`` queries, ``C`` configurations of a
query, ``E`` features, ``W`` cells of the small map, ``A`` channels of attention, ``G`` features of
each.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import RESOLUTION
from nrp_jax.homes.houses import CELLS
from nrp_jax.learning.models import ModelConfig, PatchEncoder

PUBLISHED_CHANNELS = (16, 32, 64)  # of convolutions that halve the map each


class PlanningNetwork(nn.Module):
    """Where to go from a configuration, and minus the length of the way that is left.

    The map and the goal are planned on once for a query; every configuration of the query then only
    reads the plan through its attention.
    """

    config: ModelConfig
    num_joints: int

    def setup(self):
        """Build the layers."""
        config = self.config
        channels = config.attention * config.latent
        self.map_layers = (
            [_Halving(width) for width in PUBLISHED_CHANNELS]
            if config.paper
            else [PatchCells(config)]
        )
        self.attend = Attention(config)
        self.hidden = Neighborhood(channels)
        self.first_output = Neighborhood(channels)
        self.first_memory = Neighborhood(channels)
        self.plan = nn.scan(
            PlanningStep,
            variable_broadcast="params",
            split_rngs={"params": False},
            length=config.iterations,
        )(channels)
        self.head = [nn.Dense(2 * config.width), nn.Dense(config.width)]
        self.answer = nn.Dense(self.num_joints + 1)

    def __call__(
        self, image: jax.Array, goal: jax.Array, q: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Actions (n, C, D) and values (n, C).

        Args:
            image: (n, X, Y, Z) the map.
            goal: (n, E) features.
            q: (n, C, E) features of configurations; the first two are the place of the base [m].
        """
        return self.read(self.look(image, goal), goal, q)

    def look(self, image: jax.Array, goal: jax.Array) -> jax.Array:
        """The plan (n, W, A, G) on the small map."""
        x = image
        for layer in self.map_layers:
            x = layer(x)
        # What the goal attends to, beside the map.
        n, width, depth, _ = x.shape
        cells, channels = self.attend(goal[:, None], (width, depth))
        attended = (cells[..., None] * channels[:, :, None]).reshape(n, width, depth, -1)
        x = self.hidden(jnp.concatenate([x, attended], axis=-1))
        carry = self.first_output(x), self.first_memory(x)
        (x, _), _ = self.plan(carry, None)
        return x.reshape(n, width * depth, self.config.attention, self.config.latent)

    def read(self, plan: jax.Array, goal: jax.Array, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Actions (n, C, D) and values (n, C) of a plan from :meth:`look`, a goal and ``q``."""
        side = round(plan.shape[1] ** 0.5)
        cells, channels = self.attend(q, (side, side))
        x = jnp.einsum("ncw,nwag->ncag", cells, plan) * channels[..., None]
        if self.config.paper:
            x = jnp.sum(x, axis=2)
        else:
            # The light network also sees both configurations as they are.
            x = x.reshape(*x.shape[:2], -1)
            goal = jnp.broadcast_to(goal[:, None], q.shape)
            seen = [x, q, goal, goal - q]
            if self.config.turning:
                seen += self._turns(q, goal)
            x = jnp.concatenate(seen, axis=-1)
        for layer in self.head:
            x = nn.relu(layer(x))
        answer = self.answer(x)
        return answer[..., :-1], answer[..., -1]

    def _turns(self, q: jax.Array, goal: jax.Array) -> list[jax.Array]:
        """How far joints turn from ``q`` to the goal (n, C, E), as they are and the short way."""
        num = self.config.turning
        first = self.num_joints - num  # features begin with sliding joints, cosines and sines
        cosines, sines = slice(first, first + num), slice(first + num, first + 2 * num)
        here, there = (jnp.arctan2(x[..., sines], x[..., cosines]) for x in (q, goal))
        turn = there - here
        return [turn, jnp.arctan2(jnp.sin(turn), jnp.cos(turn))]


class Attention(nn.Module):
    """Which cells, and which channels, a configuration looks at."""

    config: ModelConfig

    @nn.compact
    def __call__(self, q: jax.Array, shape: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
        """Weights (n, C, W) of the cells of a small map, and (n, C, A) of the channels.

        Args:
            q: (n, C, E) features, the place of the base first.
            shape: (2,) of the small map, W cells in all.
        """
        half = CELLS[self.config.task] * RESOLUTION / 2
        sides = [(np.arange(size) + 0.5) / size * 2 - 1 for size in shape]
        centers = jnp.asarray(np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 2))
        place = q[..., None, :2] / half
        centers = jnp.broadcast_to(centers.astype(q.dtype), (*q.shape[:2], *centers.shape))
        x = jnp.concatenate([jnp.broadcast_to(place, centers.shape), centers], axis=-1)
        for width in (16, 16, 32, 32, 64):
            x = nn.relu(nn.Dense(width)(x))
        x = nn.Dense(1)(x)[..., 0]
        if not self.config.paper:
            # The light network begins with the cell that the base stands in.
            x -= jnp.sum(((centers - place) * (max(shape) / 2)) ** 2, axis=-1)
        channels = nn.Dense(self.config.attention)(nn.relu(nn.Dense(64)(q)))
        return nn.softmax(x), nn.softmax(channels)


class PlanningStep(nn.Module):
    """One step of the convolutional LSTM."""

    channels: int

    @nn.compact
    def __call__(self, carry: tuple[jax.Array, jax.Array], _: None):
        """The next output and memory, (n, X, Y, channels) both."""
        output, memory = carry
        seen = jnp.concatenate([Neighborhood(self.channels)(output), output], axis=-1)
        keep, write, new, show = jnp.split(nn.Dense(4 * self.channels)(seen), 4, axis=-1)
        memory = nn.sigmoid(keep) * memory + nn.sigmoid(write) * jnp.tanh(new)
        return (nn.sigmoid(show) * jnp.tanh(memory), memory), None


class Neighborhood(nn.Module):
    """A convolution of 3 x 3 cells, as a matrix product: far faster on a CPU."""

    channels: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Features (n, X, Y, channels) of (n, X, Y, F)."""
        _, width, depth, _ = x.shape
        x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        parts = [x[:, i : i + width, j : j + depth] for i in range(3) for j in range(3)]
        return nn.Dense(self.channels)(jnp.concatenate(parts, axis=-1))


class PatchCells(nn.Module):
    """The map as few cells, by the patches of the light networks; heights are channels."""

    config: ModelConfig

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Features (n, X', Y', F) of images (n, X, Y, Z)."""
        side = image.shape[1] // int(np.prod(self.config.patches))
        x = PatchEncoder(self.config)(image, False)
        return x.reshape(len(x), side, -1, self.config.channels[-1])


class _Halving(nn.Module):
    """A convolution that halves the map; heights are channels."""

    channels: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return nn.relu(nn.Conv(self.channels, (3, 3), 2, 1)(x))
