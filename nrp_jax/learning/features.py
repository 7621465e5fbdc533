"""Features of configurations, and symmetries of the local frame.

Networks see configurations in the local frame: its origin is the center of the image around the
start, its axes are the map's (Lu et al. 2024). Features hold the joints and, by exact kinematics,
the positions of the link frames. Angles are given by cosine and sine, so that nothing jumps at half
a turn. Letters: ``D`` joints, ``F`` link frames, ``P`` points, ``E`` features.
"""

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.learning.models import MAP_KINDS, ModelConfig
from nrp_jax.scene.field import FINE, DistanceField
from nrp_jax.scene.robots import MobileRobot
from vrrt_jax.core.edges import short_way

MAX_GOAL_DISTANCE = 6.0  # farther goals are moved to this distance [m]
MAX_CLEARANCE = 1.0  # larger distances to obstacles are cut off [m]
PATH_SAMPLES = 4  # places along an edge at which the surroundings are read
HEADING = 2  # the joint that turns the whole robot, for both robots


def to_local(q: jax.Array, center: jax.Array) -> jax.Array:
    """Configurations (..., D) in the frame at a place (..., 2) of the map [m], with its axes."""
    return jnp.concatenate([q[..., :2] - center, q[..., 2:]], axis=-1)


def to_world(q: jax.Array, center: jax.Array) -> jax.Array:
    """The inverse of :func:`to_local`."""
    return jnp.concatenate([q[..., :2] + center, q[..., 2:]], axis=-1)


def configuration_features(
    config: ModelConfig, robot: MobileRobot, q: jax.Array, points: jax.Array
) -> jax.Array:
    """Features (E,) of one local configuration (D,): joints, then link frames.

    The published models see angles [rad], the others see the cosines and sines of the angles.

    Args:
        config: of the model.
        robot: whose configuration it is.
        q: (D,) in the local frame.
        points: (F, 3) from :func:`nrp_jax.link_features` [m]; heights only if it is not planar.
    """
    if config.paper:
        joints = q
    else:
        is_angle = np.array(robot.angular)
        angle = q[is_angle]
        joints = jnp.concatenate([q[~is_angle], jnp.cos(angle), jnp.sin(angle)])
    return jnp.concatenate([joints, (points[:, :2] if robot.planar else points).reshape(-1)])


def goal_features(
    config: ModelConfig, robot: MobileRobot, q: jax.Array, points: jax.Array
) -> jax.Array:
    """Features (E',) of one local goal (D,): those of its configuration, and where it lies.

    The published models add the direction [rad]. Networks of whole maps have nothing to add to the
    place in the map. The others move far goals to
    ``MAX_GOAL_DISTANCE``, and add the direction as a unit vector and the logarithm of the distance.

    Args:
        config: of the model.
        robot: whose configuration it is.
        q: (D,) goal in the local frame.
        points: (F, 3) its link frames [m].
    """
    if config.kind in MAP_KINDS:
        return configuration_features(config, robot, q, points)
    place = q[:2]
    if config.paper:
        direction = jnp.arctan2(place[1], place[0])
        return jnp.append(configuration_features(config, robot, q, points), direction)
    # Far goals move towards the start, together with their link frames.
    distance = jnp.sqrt(jnp.sum(place**2) + 1e-6)
    back = place * (jnp.minimum(1.0, MAX_GOAL_DISTANCE / distance) - 1.0)
    q, points = q.at[:2].add(back), points.at[:, :2].add(back)
    features = configuration_features(config, robot, q, points)
    return jnp.concatenate([features, place / distance, jnp.log(distance)[None]])


def to_configuration(config: ModelConfig, robot: MobileRobot, features: jax.Array) -> jax.Array:
    """The local configuration (..., D) that generated features (..., E) begin with."""
    num = len(robot.joint_names)
    if config.paper:
        return features[..., :num]
    is_angle = np.array(robot.angular)
    linear, cosine, sine = jnp.split(
        features[..., : num + is_angle.sum()], [num - is_angle.sum(), num], axis=-1
    )
    # Features hold sliding joints first, then turning ones: back to the robot's order.
    order = np.argsort(np.concatenate([np.flatnonzero(~is_angle), np.flatnonzero(is_angle)]))
    return jnp.concatenate([linear, jnp.arctan2(sine, cosine)], axis=-1)[..., order]


def generated_points(config: ModelConfig, robot: MobileRobot, features: jax.Array) -> jax.Array:
    """Link frames (..., F, 3) that generated features (..., E) end with [m]; planar ones at z = 0.

    They need not be exactly those of the joints that the features begin with.
    """
    num = len(robot.joint_names) + (0 if config.paper else sum(robot.angular))
    points = features[..., num:].reshape(*features.shape[:-1], -1, 2 if robot.planar else 3)
    return jnp.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, 3 - points.shape[-1])])


def standing_points(robot: MobileRobot, q: jax.Array, points: jax.Array) -> jax.Array:
    """Points (P, 3) of the robot in a local configuration (D,): link frames (F, 3) and base [m]."""
    heights = jnp.array([0.0] if robot.planar else [0.1, 0.5, 0.9])
    base = jnp.append(q[:2], 0.0) + heights[:, None] * jnp.array([0.0, 0.0, 1.0])
    return jnp.concatenate([points, base])


def passed_points(start: jax.Array, end: jax.Array, samples: int = PATH_SAMPLES) -> jax.Array:
    """Points (samples * P, 3) that the robot passes on its path from one place to another [m].

    Straight lines stand in for the true paths, which are nearly straight where the posture changes
    little.

    Args:
        start: (P, 3) points of the robot at the start.
        end: (P, 3) the same points at the end.
        samples: places on the way, the end among them.
    """
    fraction = jnp.arange(1, samples + 1)[:, None, None] / samples
    return (start + fraction * (end - start)).reshape(-1, 3)


def cells(points: jax.Array, shape: tuple[int, ...], resolution: float) -> jax.Array:
    """Flat indices (...) of the cells of an image (X, Y, Z) that hold local points (..., 3) [m]."""
    flat = jnp.int32(0)
    for axis, middle in enumerate((shape[0] // 2, shape[1] // 2, 0)):
        if shape[axis] > 1:  # axis by axis: XLA's CPU loops over a last axis of three are slow
            index = jnp.floor(points[..., axis] * (1.0 / resolution)).astype(jnp.int32) + middle
            flat = flat * shape[axis] + jnp.clip(index, 0, shape[axis] - 1)
    return flat


def interpolate(image: jax.Array, points: jax.Array, resolution: float) -> jax.Array:
    """What an image (X, Y, Z) holds at local points (..., 3) [m], between the centers of its cells.

    Unlike what the cells themselves hold, this tells which way it rises.
    """
    middle = (image.shape[0] / 2, image.shape[1] / 2, 0.0)
    axes = [axis for axis in range(3) if image.shape[axis] > 1]
    place = [points[..., axis] / resolution + middle[axis] - 0.5 for axis in axes]
    image = image.reshape([image.shape[axis] for axis in axes])
    return jax.scipy.ndimage.map_coordinates(image, place, order=1, mode="nearest")


def steps(robot: MobileRobot, q: jax.Array, end: jax.Array) -> jax.Array:
    """Distances (..., 2) of base [m] and arm [rad] between configurations (..., D) and (D,)."""
    squared = short_way(q - end, robot.is_continuous) ** 2
    base, arm = squared[..., :2].sum(-1), squared[..., robot.base_dim :].sum(-1)
    return jnp.sqrt(jnp.stack([base, arm], axis=-1) + 1e-12)


def surroundings(field: DistanceField) -> jax.Array:
    """Distances (X, Y, Z) from each cell's center to the nearest obstacle, 0 in solid cells [m].

    Distances beyond ``MAX_CLEARANCE`` count as that.
    """
    planar = field.values.shape[2] == 1
    # The lattice points at the centers of the cells; the field has a rim of one cell in x and y.
    first = FINE + FINE // 2
    inside = field.values[first:-first:FINE, first:-first:FINE]
    return jnp.minimum(inside if planar else inside[:, :, FINE // 2 :: FINE], MAX_CLEARANCE)


def turn_image(image: jax.Array, quarter: jax.Array, mirror: jax.Array) -> jax.Array:
    """Turn an image (X, Y, Z), X = Y, by quarter turns from x to y, after mirroring y if asked."""
    image = jnp.where(mirror, image[:, ::-1], image)
    turns = [lambda image, k=k: jnp.rot90(image, k) for k in range(4)]
    return jax.lax.switch(quarter, turns, image)


def turn_configuration(
    robot: MobileRobot, q: jax.Array, quarter: jax.Array, mirror: jax.Array
) -> jax.Array:
    """Turn local configurations (..., D) together with the image: see :func:`turn_image`.

    The snake's joints count clockwise from +y, the Fetch's heading counts from +x to +y.
    """
    # Mirroring y changes the sign of some joints, and turns the snake's first joint by half a turn.
    if robot.planar:
        sign = np.array([1, -1, *[-1] * 6])
        offset = np.array([0, 0, np.pi, *[0] * 5])
        clockwise = -1
    else:
        mirrored = ("y", "theta", "shoulder_pan", "upperarm_roll", "forearm_roll", "wrist_roll")
        sign = np.array([-1 if name.startswith(mirrored) else 1 for name in robot.joint_names])
        offset = np.zeros(len(sign))
        clockwise = 1
    q = jnp.where(mirror, sign * q + offset, q)
    # A quarter turn changes the heading and the place, no other joint.
    heading = q[..., HEADING] + clockwise * quarter * (jnp.pi / 2)
    heading = jnp.mod(heading + jnp.pi, 2 * jnp.pi) - jnp.pi
    return _turn(q.at[..., HEADING].set(heading), quarter)


def turn_points(points: jax.Array, quarter: jax.Array, mirror: jax.Array) -> jax.Array:
    """Turn local points (..., 3) together with the image: see :func:`turn_image`."""
    sign = jnp.where(mirror, jnp.array([1.0, -1.0, 1.0]), 1.0)
    return _turn(sign * points, quarter)


def _turn(place: jax.Array, quarter: jax.Array) -> jax.Array:
    """Turn the first two of (..., k) numbers by quarter turns from the first to the second."""
    cosine = jnp.array([1.0, 0.0, -1.0, 0.0])[quarter]
    sine = jnp.array([0.0, 1.0, 0.0, -1.0])[quarter]
    x, y = place[..., 0], place[..., 1]
    return place.at[..., 0].set(cosine * x - sine * y).at[..., 1].set(sine * x + cosine * y)
