"""How well what planners collide with agrees with the true geometry in C MuJoCo."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.closed_form import ClosedFormWorld
from vrrt_jax.scene.exact import ExactScene, exact_scene
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.world import batch_is_free, build_world

_SCENES = 20  # random scenes that the configurations are spread over
_KINDS = ("box", "sphere", "capsule", "cylinder") * 2
_MAX_DISTANCE = 0.9  # of the arm's reach: obstacles stand inside
_MIN_DISTANCE = 0.25  # of the arm's reach: free around the base


@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """Counts over configurations, :func:`vrrt_jax.is_free` against true geometry."""

    colliding: int  # truly colliding
    free: int  # truly free
    misses: int  # truly colliding, but free for planners
    false_alarms: int  # truly free, but refused

    @property
    def miss_rate(self) -> float:
        """Share of the truly colliding configurations that planners call free."""
        return self.misses / max(self.colliding, 1)

    @property
    def false_alarm_rate(self) -> float:
        """Share of the truly free configurations that planners refuse."""
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
    *,
    polytopes: bool = True,
) -> SphereReport:
    """Compare what planners collide with and the true geometry, in random configurations.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        num: number of configurations, over all scenes.
        seed: of scenes and configurations.
        scenes: obstacles of each; without any, 20 random scenes of eight boxes, spheres, capsules
            and cylinders.
        polytopes: look again with them where spheres touch, as planners do.

    Raises:
        ValueError: the true geometry is nowhere on this machine.
    """
    rng = np.random.default_rng(seed)
    reach = _reach(robot)
    rows = []
    missed: dict[tuple[str, str], int] = {}
    for index, part in enumerate(np.array_split(np.arange(num), len(scenes) or _SCENES)):
        obstacles = scenes[index] if scenes else _random_obstacles(rng, reach)
        truth = exact_scene(robot, obstacles, geometry="meshes")
        q = rng.uniform(robot.lower, robot.upper, (len(part), robot.num_joints))
        true_pairs = [_by_kind(truth, row) for row in q]
        refused = [~free for free in _free(robot, obstacles, q, polytopes)]
        touches = np.array([[bool(p) for p in pairs] for pairs in true_pairs], bool)
        rows.append(np.column_stack([touches.reshape(-1, 2), *refused]))
        for pairs, is_refused in zip(true_pairs, refused[1], strict=True):
            for first, second in pairs[1] if not is_refused else ():
                names = truth.model.body(first).name, truth.model.body(second).name
                missed[names] = missed.get(names, 0) + 1
    found = np.concatenate(rows)
    return SphereReport(
        obstacles=_agreement(found[:, 0], found[:, 2]),
        self_collision=_agreement(found[:, 1], found[:, 3]),
        either=_agreement(found[:, 0] | found[:, 1], found[:, 4]),
        num=num,
        seed=seed,
        missed=missed,
    )


def _free(
    robot: Robot, obstacles: Sequence[Obstacle], q: np.ndarray, polytopes: bool
) -> list[np.ndarray]:
    """Whether q (n, D) are free of obstacles, of the robot itself, and of both, (n,) bool each."""
    among, alone = (
        build_world(robot, things, engine="closed_form", num_slots=len(obstacles))
        for things in (obstacles, [])
    )
    if not polytopes:
        among, alone = among.by_spheres_alone(), alone.by_spheres_alone()
    assert isinstance(among, ClosedFormWorld)
    # Contact distances of zero mark pairs that are not checked.
    unchecked = jnp.zeros_like(among.spheres.contact_distance)
    spheres = dataclasses.replace(among.spheres, contact_distance=unchecked)
    worlds = dataclasses.replace(among, spheres=spheres), alone, among
    return [np.asarray(batch_is_free(world, np.float32(q))) for world in worlds]


def _agreement(truth: np.ndarray, refused: np.ndarray) -> Agreement:
    return Agreement(
        colliding=int(truth.sum()),
        free=int((~truth).sum()),
        misses=int((truth & ~refused).sum()),
        false_alarms=int((~truth & refused).sum()),
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
