"""How well spheres agree with the true geometry: misses and false alarms in C MuJoCo."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.exact import ExactScene, exact_scene
from vrrt_jax.scene.obstacles import Obstacle

_SCENES = 20  # random scenes that the configurations are spread over
_KINDS = ("box", "sphere", "capsule", "cylinder") * 2
_MAX_DISTANCE = 0.9  # of the arm's reach: obstacles stand inside
_MIN_DISTANCE = 0.25  # of the arm's reach: free around the base


@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """Counts over configurations, spheres against true geometry."""

    colliding: int  # truly colliding
    free: int  # truly free
    misses: int  # truly colliding, but the spheres are free
    false_alarms: int  # truly free, but the spheres collide

    @property
    def miss_rate(self) -> float:
        """Share of the truly colliding configurations that the spheres call free."""
        return self.misses / max(self.colliding, 1)

    @property
    def false_alarm_rate(self) -> float:
        """Share of the truly free configurations that the spheres call colliding."""
        return self.false_alarms / max(self.free, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SphereReport:
    """What :func:`measure_spheres` found."""

    obstacles: Agreement  # robot against obstacles
    self_collision: Agreement  # robot against itself
    either: Agreement  # both in one: what a planner is refused
    num: int  # configurations
    seed: int
    missed: dict[tuple[str, str], int]  # missed self-collisions by pair of bodies


def measure_spheres(
    robot: Robot,
    num: int = 10_000,
    seed: int = 0,
    scenes: Sequence[Sequence[Obstacle]] = (),
) -> SphereReport:
    """Compare a robot's spheres with its true collision geometry, in random configurations.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        num: number of configurations, over all scenes.
        seed: of scenes and configurations.
        scenes: obstacles of each; without any, 20 random scenes of eight boxes, spheres, capsules
            and cylinders.

    Raises:
        ValueError: the true geometry is nowhere on this machine.
    """
    rng = np.random.default_rng(seed)
    reach = _reach(robot)
    rows: list[list[bool]] = []
    missed: dict[tuple[str, str], int] = {}
    for index, scene in enumerate(np.array_split(np.arange(num), len(scenes) or _SCENES)):
        # One scene twice: with the true geometry, and with the spheres.
        obstacles = scenes[index] if scenes else _random_obstacles(rng, reach)
        truth = exact_scene(robot, obstacles, geometry="meshes")
        spheres = exact_scene(robot, obstacles, geometry="spheres")
        for q in rng.uniform(robot.lower, robot.upper, (len(scene), robot.num_joints)):
            true_pairs, sphere_pairs = _by_kind(truth, q), _by_kind(spheres, q)
            rows.append([bool(pairs) for pairs in true_pairs + sphere_pairs])
            for first, second in true_pairs[1] if not sphere_pairs[1] else ():
                names = truth.model.body(first).name, truth.model.body(second).name
                missed[names] = missed.get(names, 0) + 1
    found = np.array(rows)
    return SphereReport(
        obstacles=_agreement(found[:, 0], found[:, 2]),
        self_collision=_agreement(found[:, 1], found[:, 3]),
        either=_agreement(found[:, 0] | found[:, 1], found[:, 2] | found[:, 3]),
        num=num,
        seed=seed,
        missed=missed,
    )


def _agreement(truth: np.ndarray, spheres: np.ndarray) -> Agreement:
    return Agreement(
        colliding=int(truth.sum()),
        free=int((~truth).sum()),
        misses=int((truth & ~spheres).sum()),
        false_alarms=int((~truth & spheres).sum()),
    )


def _by_kind(exact: ExactScene, q: np.ndarray) -> list[list[tuple[int, int]]]:
    """Touching pairs of bodies at ``q`` (D,): with obstacles, and of the robot with itself."""
    pairs = exact.touching(q)
    return [
        [pair for pair in pairs if pair[1] >= exact.num_bodies],
        [pair for pair in pairs if pair[1] < exact.num_bodies],
    ]


def _reach(robot: Robot) -> float:
    """How far the moving spheres get from the origin [m], in 200 random configurations."""
    exact = exact_scene(robot, [], geometry="spheres")
    rng = np.random.default_rng(0)
    reach = 0.0
    for q in rng.uniform(robot.lower, robot.upper, (200, robot.num_joints)):
        exact.touching(q)
        far = np.linalg.norm(exact.data.geom_xpos[exact.robot_geoms], axis=1)
        reach = max(reach, float(far.max()))
    return reach


def _random_obstacles(rng: np.random.Generator, reach: float) -> list[Obstacle]:
    """Eight obstacles inside the reach [m], of 4 % to 15 % of it, and clear of the base."""
    obstacles = []
    while len(obstacles) < len(_KINDS):
        position = rng.uniform([-1, -1, 0], [1, 1, 1]) * reach
        if not _MIN_DISTANCE * reach < np.linalg.norm(position[:2]):
            continue
        if np.linalg.norm(position) > _MAX_DISTANCE * reach:
            continue
        quaternion = rng.normal(size=4)
        index = len(obstacles)
        obstacles.append(
            Obstacle(
                name=f"{_KINDS[index]}_{index}",
                kind=_KINDS[index],
                position=tuple(position),
                quaternion=tuple(quaternion / np.linalg.norm(quaternion)),
                size=tuple(rng.uniform(0.04, 0.15, 3) * reach),
            )
        )
    return obstacles
