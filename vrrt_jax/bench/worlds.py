"""Random worlds: five to ten obstacles around a robot."""

from collections.abc import Sequence

import numpy as np

from vrrt_jax.robots import Robot
from vrrt_jax.robots.robot import workspace
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import contacts

COUNT = (5, 10)  # obstacles, beside the floor
KINDS = ("box", "sphere", "capsule", "cylinder")
SIZE = (0.06, 0.14)  # [m] radii and half edges
LENGTH = (0.15, 0.35)  # [m] half lengths of capsules and cylinders
SHELL = (0.25, 0.85)  # distance of centers from the workspace's, in its radii
COLORS = ((0.30, 0.50, 0.75), (0.85, 0.65, 0.25), (0.85, 0.45, 0.30), (0.45, 0.65, 0.45))
MOST_DRAWS = 1000  # of an obstacle


def random_world(robot: Robot, seed: int) -> list[Obstacle]:
    """A floor and random obstacles within reach, none of which touches the robot at home.

    Raises:
        ValueError: the robot touches itself or the floor at home.
    """
    rng = np.random.default_rng(seed)
    center, radius = workspace(robot)
    floor = Obstacle(
        name="floor",
        kind="plane",
        position=(0.0, 0.0, -0.01),
        size=(1.5, 1.5, 0.05),
        rgba=(0.86, 0.87, 0.90, 1.0),
    )
    obstacles: list[Obstacle] = [floor]
    if touching := contacts(robot, obstacles, robot.home, geometry="spheres"):
        raise ValueError(
            f"the robot is in collision at home: {'; '.join(touching)}; expected a free keyframe "
            "'home' in its file"
        )
    num = int(rng.integers(COUNT[0], COUNT[1] + 1))
    for _ in range(MOST_DRAWS):
        if len(obstacles) > num:
            return obstacles
        obstacle = _random_obstacle(len(obstacles), center, radius, rng)
        touching = contacts(robot, [*obstacles, obstacle], robot.home, geometry="spheres")
        if obstacle.position[2] > 0.1 and not touching:
            obstacles.append(obstacle)
    raise ValueError(
        f"found room for {len(obstacles) - 1} obstacles around the robot, expected {num}; it is "
        f"too small for obstacles of {SIZE[0]} to {SIZE[1]} m"
    )


def _random_obstacle(
    index: int, center: np.ndarray, radius: float, rng: np.random.Generator
) -> Obstacle:
    kind = KINDS[rng.integers(len(KINDS))]
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    position = center + radius * rng.uniform(*SHELL) * direction
    a, b, c = rng.uniform(*SIZE, 3)
    size = {
        "box": (a, b, c),
        "sphere": (a, 0.0, 0.0),
        "capsule": (0.6 * a, rng.uniform(*LENGTH), 0.0),
        "cylinder": (0.6 * a, rng.uniform(*LENGTH), 0.0),
    }[kind]
    turn = rng.normal(size=4)
    return Obstacle(
        name=f"{kind}_{index}",
        kind=kind,
        position=_rounded(position),
        quaternion=_rounded(turn / np.linalg.norm(turn)),
        size=_rounded(size),
        rgba=(*COLORS[index % len(COLORS)], 1.0),
    )


def _rounded(values: Sequence[float] | np.ndarray) -> tuple:
    return tuple(round(float(value), 4) for value in values)
