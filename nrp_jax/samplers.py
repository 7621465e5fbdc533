"""Learned samplers: waypoints for many starts and goals at once.

Pytrees, so that other weights never re-compile a planner. Letters: ``B`` lanes, ``C`` candidates,
``D`` joints, ``E`` features.
"""

import functools
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from nrp_jax.homes.grid import HEIGHT, RESOLUTION
from nrp_jax.learning import features
from nrp_jax.learning.batches import describe, read, relations, surrounding_map, view
from nrp_jax.learning.checkpoint import Model, build_module, check_model, load_model
from nrp_jax.learning.local_map import SIDE
from nrp_jax.learning.models import CVAE, ModelConfig, check_choices
from nrp_jax.scene.robots import MobileRobot, batch_link_features, load_robot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import difference, enforce_bounds, points_along
from vrrt_jax.core.types import pytree, static

REACH = SIDE / 2 * RESOLUTION  # of a window from its middle [m]
POSTURES = 16  # between a start's and a goal's
SPREAD = 1.0  # how far at most a joint is off these postures [rad] or [m]


class Sampler(Protocol):
    """Proposes where a planner should go next."""

    def propose(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> jax.Array:
        """Waypoints (B, D) inside the limits, from starts (B, D) on the way to goals (B, D)."""
        ...


@pytree
class Discriminator:
    """NRP-d: the best of many random candidates, in the eyes of the discriminator.

    The candidates stand anywhere in the window, in postures between the start's and the goal's. The
    goal itself is one where it lies in the window. Those that stand in something solid are out
    before the network looks.
    """

    robot: MobileRobot
    variables: Any
    config: ModelConfig = static()
    candidates: int = static(default=256)  # in whole sixteens
    max_scored: int = static(default=96)  # most that the network looks at
    checked: int = static(default=16)  # of the best, the first whose edge seems free is taken
    edge_checks: int = static(default=12)  # configurations looked at along each of these edges

    def propose(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> jax.Array:
        """See :class:`Sampler`."""
        sight = _look(self.config, self.robot, world, q_from, q_goal)
        q, points = self._candidates(world, q_from, q_goal, key)
        if self.config.scope == "map":  # its frame is the map's, candidates are about the start
            shift = jnp.pad(features.to_local(q_from, sight.center)[:, :2], ((0, 0), (0, 1)))
            q = q.at[..., :2].add(shift[:, None, :2])
            points = points + shift[:, None, None]
        q = jnp.concatenate([sight.ends[:, 1:], q], axis=1)
        points = jnp.concatenate([sight.end_points[:, 1:], points], axis=1)
        near = jnp.max(jnp.abs(q_goal - q_from)[:, :2], axis=1) < REACH
        possible = jnp.ones(q.shape[:2], bool).at[:, 0].set(near)
        if self.config.lookup and self.max_scored < q.shape[1]:
            standing = jax.vmap(jax.vmap(functools.partial(features.standing_points, self.robot)))
            blocked = jnp.min(jax.vmap(read)(sight.image, standing(q, points)), axis=-1) <= 0
            rank = jnp.where(possible, jnp.where(blocked, 1.0, 2.0), 0.0)
            _, kept = jax.lax.top_k(rank, self.max_scored)
            q, points, possible = jax.vmap(
                lambda kept, arrays: jax.tree.map(lambda x: x[kept], arrays)
            )(kept, (q, points, possible))
        relation = jax.vmap(functools.partial(relations, self.robot))(
            sight.image,
            jnp.concatenate([sight.ends, q], axis=1),
            jnp.concatenate([sight.end_points, points], axis=1),
        )
        module: Any = build_module(self.config, 0)
        logits = module.apply(
            self.variables,
            sight.image,
            sight.start,
            sight.goal,
            describe(self.config, self.robot, q, points),
            relation,
        )
        many = min(self.checked, q.shape[1])
        _, best = jax.lax.top_k(jnp.where(possible, logits, -jnp.inf), many)
        chosen = jnp.take_along_axis(q, best[..., None], axis=1)
        chosen = enforce_bounds(world, features.to_world(chosen, sight.center[:, None]))
        return _first_free(world, q_from, chosen, self.edge_checks)

    def _candidates(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Local configurations (B, C, D) and their frames (B, C, F, 3)."""
        key_posture, key_place = jax.random.split(key)
        shape = (len(q_from), round(self.candidates / POSTURES), POSTURES)
        place = jax.random.uniform(key_place, (*shape, 2), minval=-REACH, maxval=REACH)
        q = _postures(self.robot, world, q_from, q_goal, key_posture)
        frames = jax.vmap(batch_link_features, (None, 0))(self.robot, q)
        q = jnp.broadcast_to(q[:, None], (*shape, q.shape[-1])).at[..., :2].set(place)
        frames = frames[:, None] + jnp.pad(place, [(0, 0)] * 3 + [(0, 1)])[..., None, :]
        return jax.tree.map(
            lambda x: x.reshape(len(x), shape[1] * POSTURES, *x.shape[3:]), (q, frames)
        )


@pytree
class Generator:
    """NRP-g: what the CVAE's decoder makes of random latents."""

    robot: MobileRobot
    variables: Any
    config: ModelConfig = static()
    num_outputs: int = static()
    checked: int = static(default=8)  # waypoints made; the first whose edge seems free is taken
    edge_checks: int = static(default=12)  # configurations looked at along each of these edges

    def propose(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> jax.Array:
        """See :class:`Sampler`."""
        sight = _look(self.config, self.robot, world, q_from, q_goal)
        z = jax.random.normal(key, (len(q_from), self.checked, self.config.latent))
        module: Any = build_module(self.config, self.num_outputs)
        made = module.apply(
            self.variables, sight.image, sight.start, sight.goal, z, method=CVAE.decode
        )
        q = features.to_configuration(self.config, self.robot, made)
        q = enforce_bounds(world, features.to_world(q, sight.center[:, None]))
        return _first_free(world, q_from, q, self.edge_checks)


@pytree
class _Sight:
    """What the networks are told about B starts and goals."""

    image: jax.Array  # (B, X, Y, Z)
    center: jax.Array  # (B, 2) of the local frames [m]
    start: jax.Array  # (B, E)
    goal: jax.Array  # (B, E')
    ends: jax.Array  # (B, 2, D) local
    end_points: jax.Array  # (B, 2, F, 3) their link frames, local [m]


def _look(
    config: ModelConfig, robot: MobileRobot, world: GridWorld, q_from: jax.Array, q_goal: jax.Array
) -> _Sight:
    padded = surrounding_map(config, world.field)
    resolution = world.field.resolution
    origin = world.field.origin[:2] + resolution  # the field has a rim of one cell
    image, center = jax.vmap(lambda q: view(config, padded, q, resolution, origin))(q_from)
    ends = jnp.stack([q_from, q_goal], axis=1)
    ends = features.to_local(ends, center[:, None])
    points = jax.vmap(batch_link_features, (None, 0))(robot, ends)
    return _Sight(
        image=image,
        center=center,
        start=describe(config, robot, ends[:, :1], points[:, :1])[:, 0],
        goal=jax.vmap(lambda q, p: features.goal_features(config, robot, q, p))(
            ends[:, 1], points[:, 1]
        ),
        ends=ends,
        end_points=points,
    )


def _postures(
    robot: MobileRobot, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
) -> jax.Array:
    """Configurations (B, POSTURES, D) at the origin, with arms between the starts' and the goals'.

    A base that turns heads anywhere.
    """
    step = difference(world, q_from, q_goal)[:, None]
    q = q_from[:, None] + jnp.linspace(0.0, 1.0, POSTURES)[:, None] * step
    key_noise, key_scale = jax.random.split(key)
    noise = jax.random.uniform(key_noise, q.shape, minval=-1.0, maxval=1.0)
    scale = SPREAD * jax.random.uniform(key_scale, (*q.shape[:2], 1)) ** 2
    base = jnp.arange(q.shape[-1]) < robot.base_dim
    q = jnp.where(base, jnp.pi * noise, q + scale * noise)
    return enforce_bounds(world, q.at[..., :2].set(0.0)).at[..., :2].set(0.0)


def _first_free(world: GridWorld, q_from: jax.Array, q: jax.Array, num_checks: int) -> jax.Array:
    """Of waypoints (B, K, D), best first, the first (B, D) whose edge seems free, or else the best.

    Looks at ``num_checks`` configurations of each edge, the waypoint the last of them. B edges are
    looked at in a round, of lanes that have found none; most lanes are done after the first.
    """
    lanes, many, joints = q.shape
    if many == 1:
        return q[:, 0]
    turn = jnp.arange(many)[None] * lanes + jnp.arange(lanes)[:, None]  # who is next

    def look(state):
        pending, free = state
        _, index = jax.lax.top_k(-jnp.where(pending, turn, many * lanes).reshape(-1), lanes)
        lane = index // many
        edge = world.edge(q_from[lane], q.reshape(-1, joints)[index])
        points = points_along(world, q_from[lane], edge, num_checks)
        ok = jax.vmap(world.is_free)(points.reshape(-1, joints)).reshape(lanes, num_checks)
        free = free.at[lane, index % many].max(jnp.all(ok, axis=1))
        pending = pending.at[lane, index % many].set(False)
        return pending & ~jnp.any(free, axis=1, keepdims=True), free

    untried = jnp.ones((lanes, many), bool)
    _, free = jax.lax.while_loop(lambda s: jnp.any(s[0]), look, (untried, ~untried))
    return jnp.take_along_axis(q, jnp.argmax(free, axis=1)[:, None, None], axis=1)[:, 0]


def make_sampler(model: Model, **settings: Any) -> Discriminator | Generator:
    """A sampler of a trained model; settings are fields such as ``candidates`` or ``checked``."""
    robot, config = load_robot(model.config.task), model.config
    shared = {"robot": robot, "variables": model.variables, "config": config, **settings}
    if config.kind == "discriminator":
        return Discriminator(**shared)
    return Generator(num_outputs=model.info["num_outputs"], **shared)


def load_sampler(
    task: str, kind: str, path: str | Path | None = None, **settings: Any
) -> Discriminator | Generator:
    """Load a sampler's weights.

    Args:
        task: "snake" or "fetch".
        kind: "discriminator" or "cvae".
        path: what ``nrp train`` wrote, a folder or its ``model.npz``; the packaged weights if None.
        settings: fields of :class:`Discriminator` or :class:`Generator` to set.

    Raises:
        ValueError: there is no such model, or it is for another task or of another kind.
    """
    check_choices(task, kind)
    path = Path(__file__).parent / "weights" / f"{task}_{kind}.npz" if path is None else Path(path)
    model = load_model(path)
    check_model(model, path, task=task, kind=kind)
    return make_sampler(model, **settings)


def check_fits(sampler: Any, robot: MobileRobot, world: GridWorld, kind: str) -> None:
    """Raise a ValueError if a sampler of this module is for something else.

    Args:
        sampler: any sampler; those of other makes are trusted.
        robot: that is planned for.
        world: the robot in a home.
        kind: "discriminator" or "cvae".
    """
    if not isinstance(sampler, Discriminator | Generator):
        return
    config = sampler.config
    if (config.task, config.kind) != (robot.name, kind):
        raise ValueError(
            f"the sampler is the {config.kind} of '{config.task}'; expected the {kind} of "
            f"'{robot.name}': load_sampler('{robot.name}', '{kind}')"
        )
    cell = float(world.field.resolution)
    layers = jax.eval_shape(features.surroundings, world.field).shape[2]
    expected = 1 if robot.planar else round(HEIGHT / RESOLUTION)
    if abs(cell - RESOLUTION) > 1e-6 or layers != expected:
        raise ValueError(
            f"the map has {layers} layers of cells of {cell:g} m; samplers have seen {expected} of "
            f"{RESOLUTION} m: see nrp_jax.homes.grid.coarsened and Grid.crop"
        )
    bottom = float(world.field.origin[2])
    if not robot.planar and abs(bottom) > RESOLUTION / 2:
        raise ValueError(
            f"the map's layers begin at z = {bottom:g} m; samplers have seen maps from 0 m up: cut "
            "or add layers at the bottom"
        )


@jax.jit
def propose(
    sampler: Sampler,
    world: GridWorld,
    q_from: jax.Array,
    q_goal: jax.Array,
    key: jax.Array,
) -> jax.Array:
    """Waypoints (B, D), compiled, for use from the host; see :class:`Sampler`."""
    return sampler.propose(world, q_from, q_goal, key)
