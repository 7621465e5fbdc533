"""Learned samplers: they propose waypoints for many starts and goals at once.

A waypoint is a configuration near the start from which the goal is easier to reach. Samplers that
generate are in :mod:`nrp_jax.generators`; among them one that samples whole paths. Samplers are
pytrees, so that other weights never re-compile a planner. Letters: ``B`` lanes, ``C`` candidates,
``D`` joints, ``F`` link frames, ``K`` waypoints of a lane.
"""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax.errors import FlaxError

from nrp_jax.generators import CVAESampler, Generator, GlobalCVAESampler
from nrp_jax.guides import NEXTGuide
from nrp_jax.homes.grid import HEIGHT, RESOLUTION
from nrp_jax.homes.houses import CELLS
from nrp_jax.learning import features
from nrp_jax.learning.batches import describe, relations
from nrp_jax.learning.candidates import DRAWN, MAX_SCORED, draw_candidates, drop_colliding
from nrp_jax.learning.checkpoint import Model, build_module, check_model, load_model
from nrp_jax.learning.edge_check import first_free
from nrp_jax.learning.experience_database import load_database
from nrp_jax.learning.models import FIRE, GLOBAL_CVAE, NEXT, ModelConfig, check_choices
from nrp_jax.learning.network_inputs import NetworkInputs, network_inputs
from nrp_jax.retrieval import ExperienceSampler
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree, static

# Settings of a robot where they are not those of the samplers' classes. The Fetch stands where few
# waypoints can be reached, so that the edges to more of them are checked.
SETTINGS: dict[tuple[str, str], dict[str, Any]] = {
    ("fetch", "discriminator"): {"num_edge_checked": 48},
    ("fetch", "cvae"): {"num_edge_checked": 24},
}


class Sampler(Protocol):
    """Proposes where a planner should go next."""

    def propose(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> jax.Array:
        """Propose one waypoint a lane.

        Args:
            world: the robot in a home.
            q_from: (B, D) starts.
            q_goal: (B, D) goals.
            key: random key.

        Returns:
            (B, D) waypoints inside the limits; they may collide.
        """
        ...


@pytree
class DiscriminatorSampler:
    """NRP-d: draws random candidates and takes the one that the discriminator scores best.

    Candidates stand anywhere in the local window, in postures between the start's and the goal's.
    The goal itself is a candidate where it lies in the window. Candidates that stand in solid cells
    are dropped before the network scores the others.
    """

    robot: MobileRobot
    variables: Any  # weights, flax variables
    config: ModelConfig = static()
    candidates: int = static(default=DRAWN)  # drawn for a lane, a multiple of ``POSTURES``
    max_scored: int = static(default=MAX_SCORED)  # candidates that the network scores, at most
    # The edges to so many of the best candidates are checked; the first that is free is taken.
    num_edge_checked: int = static(default=16)
    edge_checks: int = static(default=12)  # configurations checked along each of these edges
    # FloorWays; the odds of a candidate fall by a factor of e for each meter that is left from it.
    floor: Any = None

    def propose(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> jax.Array:
        """See :class:`Sampler`."""
        return self.propose_and_count(world, q_from, q_goal, key)[0]

    def propose_and_count(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Waypoints as :meth:`propose` makes them, and how many configurations it checked."""
        inputs = network_inputs(self.config, self.robot, world, q_from, q_goal)
        q, points, possible = draw_candidates(
            self.robot, world, inputs, q_from, q_goal, key, num=self.candidates
        )
        if self.config.lookup and self.max_scored < q.shape[1]:
            q, points, possible = drop_colliding(
                self.robot, inputs, q, points, possible, self.max_scored
            )
        logits = self._score(inputs, q, points)
        if self.floor is not None:
            there = features.to_world(q, inputs.center[:, None])
            logits -= self.floor.between(there, q_goal[:, None])
        # The best candidates, back in the map and inside the limits.
        num = min(self.num_edge_checked, q.shape[1])
        _, best = jax.lax.top_k(jnp.where(possible, logits, -jnp.inf), num)
        chosen = jnp.take_along_axis(q, best[..., None], axis=1)
        chosen = enforce_bounds(world, features.to_world(chosen, inputs.center[:, None]))
        return first_free(world, q_from, chosen, self.edge_checks)

    def _score(self, inputs: NetworkInputs, q: jax.Array, points: jax.Array) -> jax.Array:
        """The network's logits (B, C) for candidates (B, C, D) with link frames (B, C, F, 3)."""
        relation = jax.vmap(functools.partial(relations, self.robot))(
            inputs.image,
            jnp.concatenate([inputs.ends, q], axis=1),
            jnp.concatenate([inputs.end_points, points], axis=1),
        )
        module: Any = build_module(self.config, 0)
        return module.apply(
            self.variables,
            inputs.image,
            inputs.start,
            inputs.goal,
            describe(self.config, self.robot, q, points),
            relation,
        )


def proposed(
    sampler: Any, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
) -> tuple[jax.Array, Any]:
    """Waypoints (B, D) of a sampler, and how many configurations it checked for collision, ().

    A sampler without ``propose_and_count`` counts as one that checks nothing.
    """
    if hasattr(sampler, "propose_and_count"):
        return sampler.propose_and_count(world, q_from, q_goal, key)
    return sampler.propose(world, q_from, q_goal, key), 0


@single_precision
def make_sampler(model: Model, **settings: Any) -> Any:
    """Make a sampler of a trained model, of the class that its kind asks for.

    Args:
        model: from :func:`nrp_jax.learning.checkpoint.load_model` or a training.
        settings: fields of the sampler's class; those in :data:`SETTINGS`, or the class's, by
            default.
    """
    robot, config = load_robot(model.config.task), model.config
    settings = {**SETTINGS.get((config.task, config.kind), {}), **settings}
    shared = {"robot": robot, "variables": model.variables, "config": config, **settings}
    if config.kind == "discriminator":
        return DiscriminatorSampler(**shared)
    make = {GLOBAL_CVAE: GlobalCVAESampler, NEXT: NEXTGuide}.get(config.kind, CVAESampler)
    return make(num_outputs=model.info["num_outputs"], **shared)


def packaged_file(task: str, kind: str) -> Path:
    """Where the packaged weights of a kind are, if there are any."""
    return Path(__file__).parent / "weights" / f"{task}_{kind}.npz"


@single_precision
def load_sampler(task: str, kind: str, path: str | Path | None = None, **settings: Any) -> Any:
    """Load a sampler's weights.

    Args:
        task: "snake" or "fetch".
        kind: "discriminator", "cvae", "global-cvae", "next" or "fire".
        path: a folder that ``nrp train`` wrote, or the ``model.npz`` in it; the packaged weights
            if None.
        settings: fields of the sampler's class, such as ``num_edge_checked``.

    Returns:
        A :class:`DiscriminatorSampler`, :class:`CVAESampler`, :class:`GlobalCVAESampler`,
        :class:`NEXTGuide` or :class:`ExperienceSampler`.

    Raises:
        ValueError: there is no such model, or it is for another task or of another kind.
    """
    path = packaged_file(task, kind) if path is None else Path(path)
    if kind == FIRE:
        return ExperienceSampler(load_robot(task), load_database(path, task), **settings)
    check_choices(task, kind)
    model = load_model(path)
    check_model(model, path, task=task, kind=kind)
    if type(model.info.get("num_outputs")) is not int:
        raise ValueError(f"'{path}' does not say how many outputs its network has")
    return make_sampler(model, **settings)


@contextlib.contextmanager
def weights_of(*paths: str | Path) -> Iterator[None]:
    """What networks raise inside for weights that are not theirs names the files, if there are any.

    Weights and the description beside them are first put together where a network is asked.
    """
    try:
        yield
    except (FlaxError, TypeError, ArithmeticError, LookupError) as error:
        if not paths:
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        named = ", ".join(f"'{path}'" for path in paths)
        raise ValueError(
            f"the weights in {named} are not those of the network that "
            f"is described there ({text[:200]}); train it again with: nrp train"
        ) from None


@single_precision
def check_fits(sampler: Any, robot: MobileRobot, world: GridWorld, kind: str) -> None:
    """Check that a sampler of this module suits a robot and a map.

    Args:
        sampler: any sampler; of other classes only the method that planners call is checked.
        robot: to plan for.
        world: the robot in a home.
        kind: "discriminator", "cvae", "global-cvae", "next" or "fire", which the planner needs.

    Raises:
        ValueError: the sampler is of another task or kind, or the map's cells are others than those
            that the networks were trained on, or more than a network of whole maps can see.
    """
    if not isinstance(sampler, DiscriminatorSampler | Generator | NEXTGuide | ExperienceSampler):
        method = {GLOBAL_CVAE: "draw", NEXT: "of_query", FIRE: "retrieve"}.get(kind, "propose")
        if not hasattr(sampler, method):
            raise ValueError(
                f"the sampler, a {type(sampler).__name__}, has no method {method}; expected one as "
                f"of load_sampler('{robot.name}', '{kind}')"
            )
        return
    config = sampler.config
    if (config.task, config.kind) != (robot.name, kind):
        raise ValueError(
            f"the sampler is the {config.kind} of '{config.task}'; expected the {kind} of "
            f"'{robot.name}': load_sampler('{robot.name}', '{kind}')"
        )
    cell = float(world.field.resolution)
    *sides, layers = jax.eval_shape(features.surroundings, world.field).shape
    expected = 1 if robot.planar else round(HEIGHT / RESOLUTION)
    if abs(cell - RESOLUTION) > 1e-6 or layers != expected:
        raise ValueError(
            f"the map has {layers} layers of cells of {cell:g} m; samplers have seen {expected} of "
            f"{RESOLUTION} m: see nrp_jax.homes.grid.coarsened and Grid.crop"
        )
    most = CELLS[config.task]
    if config.scope == "map" and max(sides) > most:
        raise ValueError(
            f"the map has {sides[0]} x {sides[1]} cells; networks that see the whole map see "
            f"{most} x {most} at most: crop it, or take a planner that sees windows, such as "
            "nrp-connect"
        )
    bottom = float(world.near[0].bottom)
    if not robot.planar and abs(bottom) > RESOLUTION / 2:
        raise ValueError(
            f"the map's layers begin at z = {bottom:g} m; samplers have seen maps from 0 m up: cut "
            "or add layers at the bottom"
        )


@single_precision
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
