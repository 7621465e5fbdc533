"""What a configuration touches, in words, and the free configuration that is nearest to it."""

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.grid_world import GridWorld
from nrp_jax.scene.near_cells import occupied_cells
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import batch_is_free, corner_of, from_corner
from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.goal import ConfigurationGoal

WITHIN_M, WITHIN_RAD = 0.05, 0.1  # how far a free configuration is looked for, joint by joint
_BATCH, _ROUNDS = 2048, 8
_FAR = 2000.0  # [m] where float32 tells places a tenth of a millimeter apart
_AROUND = 2.0  # [m] of the map around the base that decides what the robot touches


def working_world(
    world: GridWorld, goal: ConfigurationGoal | None = None
) -> tuple[GridWorld, np.ndarray]:
    """The world that planners work in, and what to add (2,) to its places [m].

    It begins at the corner of the map. A subclass of a world or a goal may know places of the map:
    with one, the world stays as it is.

    Raises:
        ValueError: such a subclass, on a map so far away that float32 has too few digits.
    """
    corner = corner_of(world)
    of_ones_own = [
        type(thing).__name__
        for thing in (world, goal)
        if type(thing) not in (GridWorld, CarWorld, ConfigurationGoal, type(None))
    ]
    if not of_ones_own:
        return from_corner(world), corner
    if np.abs(corner).max() > _FAR:
        raise ValueError(
            f"the map begins at {tuple(corner.tolist())} m, too far away for the places that "
            f"{' and '.join(of_ones_own)} may know; shift the map's origin to within {_FAR:g} m of "
            "0"
        )
    return world, np.zeros(2)


def shifted(q: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Configurations (..., D), in float64, with their bases moved by (2,) [m]."""
    q = np.array(q, np.float64)
    q[..., :2] += by
    return q


def nearest_free(
    robot: MobileRobot, world: GridWorld, q: np.ndarray, *, key: jax.Array | None = None
) -> np.ndarray | None:
    """Look for the free configuration that is nearest to one, within 0.05 m and 0.1 rad a joint.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        world: of this robot, from :func:`nrp_jax.build_world`.
        q: (D,) configuration [m] and [rad]; it may be outside the limits.
        key: random key of the samples; the same key finds the same configuration.

    Returns:
        (D,) in float64, of five decimals, inside the limits; None if nothing free was found.

    Raises:
        ValueError: ``q`` has another shape, or is not finite.
    """
    q = np.array(q, np.float64)
    if q.shape != (robot.num_joints,) or not np.isfinite(q).all():
        names = ", ".join(robot.joint_names)
        raise ValueError(f"q is {q}; expected ({robot.num_joints},) finite numbers: {names}")
    inner, corner = working_world(world)
    local = shifted(q, -corner)
    # Limits of all samples: those of the joints, and those around the configuration.
    reach = np.where(robot.angular, WITHIN_RAD, WITHIN_M)
    turns = np.asarray(world.is_continuous)
    lower, upper = (np.asarray(a, np.float64) for a in (inner.lower, inner.upper))
    low = np.maximum(local - reach, np.where(turns, -np.inf, lower))
    high = np.minimum(local + reach, np.where(turns, np.inf, upper))
    if (low > high).any():
        return None
    rng = np.random.default_rng(
        np.asarray(jax.random.key_data(jax.random.key(0) if key is None else key))
    )
    # The first samples are all around it. Later ones are around the best so far, ever nearer.
    best, center, scale = None, np.clip(local, low, high), 1.0
    for _ in range(_ROUNDS):
        step = rng.uniform(-1, 1, (_BATCH, len(q))) * reach * scale
        step *= rng.uniform(size=(_BATCH, 1))
        step *= rng.random((_BATCH, len(q))) < rng.choice([0.2, 0.5, 1.0], (_BATCH, 1))
        # Some lie on the way from the configuration to the best so far.
        samples, samples[0] = center + step, center
        if best is not None:
            share = np.linspace(0, 1, _BATCH // 4)[:, None]
            samples[1 : 1 + len(share)] = local + share * (best - local)
            scale /= 2
        # As few digits as people type, so that what is named is free.
        samples = shifted(np.round(shifted(np.clip(samples, low, high), corner), 5), -corner)
        is_free = batch_is_free(inner, jnp.asarray(samples, jnp.float32))
        free = samples[np.asarray(is_free)]
        if len(free):
            found = free[np.argmin(_deviation(free - local, reach))]
            if best is None or _deviation(found - local, reach) < _deviation(best - local, reach):
                best = center = found
    return None if best is None else np.round(shifted(best, corner), 5)


def _deviation(step: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """How far steps (..., D) lead, all joints counted by what is allowed."""
    return np.linalg.norm(step / reach, axis=-1)


def touching(robot: MobileRobot, world: GridWorld, q: np.ndarray) -> str:
    """Words for what a configuration (D,) touches: "wrist_roll touches the map at (1.20, 3.05)".

    C MuJoCo tells, in the part of the map around the base. Where the planner refuses what C MuJoCo
    allows, this is the pair that is nearest, with its distance.
    """
    near, corner = world.near[0], corner_of(world)
    cell = float(near.cell)
    # The cells around the base.
    base = np.floor((q[:2] - corner) / cell).astype(int)
    first = np.maximum(base - round(_AROUND / cell), 0)
    last = base + round(_AROUND / cell) + 1
    solid = occupied_cells(near)[first[0] : last[0], first[1] : last[1]]
    origin = (*(corner + first * cell), float(near.bottom))
    scene = ExactScene(robot, Grid(occupied=solid, resolution=cell, origin=origin))
    return scene.nearest_contact(q)


def refusal(robot: MobileRobot, world: GridWorld, q: np.ndarray, what: str) -> str:
    """Why a configuration (D,) is refused, and which free one is nearest."""
    if overrides_is_free(world):
        problem = f"the {what} is refused by {type(world).__name__}.is_free"
    else:
        problem = f"the {what} is not free: {touching(robot, world, q)}"
    return f"{problem}: {np.round(q, 3).tolist()}; {advice(robot, world, q)}"


def advice(robot: MobileRobot, world: GridWorld, q: np.ndarray) -> str:
    """What to take instead of a configuration (D,) that is not free or outside the limits."""
    free = nearest_free(robot, world, q)
    if free is None:
        return f"choose another one: none was found within {WITHIN_M} m and {WITHIN_RAD} rad"
    return f"the nearest free configuration found is {','.join(f'{v:.9g}' for v in free)}"
