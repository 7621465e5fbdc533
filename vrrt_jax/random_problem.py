"""Problems drawn at random for any robot, with a goal image that MuJoCo renders.

They try a robot without a photograph; the benchmark's tasks are drawn likewise.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from vrrt_jax.checks import check_limits
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.precision import single_precision
from vrrt_jax.problems import Problem
from vrrt_jax.robots.mesh_sources import needed_mesh_spec
from vrrt_jax.robots.robot import Robot, workspace
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import World, batch_is_free, obstacle_list
from vrrt_jax.splat.camera import orbit
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.mujoco_images import MeshRenderer, Picture
from vrrt_jax.splat.types import Camera

MOST_DRAWS = 400  # of 256 pairs of ends each
IMAGE_PX = 480
AZIMUTH_DEG = 180.0  # from the front
ELEVATION_DEG = -30.0
DISTANCE = 2.1  # of the camera, in radii of the workspace


@single_precision
def random_problem(
    robot: Robot,
    world: World,
    self_model: SelfModel,
    *,
    seed: int,
    distance: float = 1.0,
    q_start: np.ndarray | None = None,
) -> Problem:
    """Draw a goal and show it in an image of the robot's true meshes, seen from the front.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        world: of the robot and its obstacles, which the image does not show.
        self_model: of the robot.
        seed: of start and goal.
        distance: from the start to the goal [rad].
        q_start: (D,) start configuration [rad] or [m]; drawn too if it is not given.

    Returns:
        The problem; its ``true_goal`` is what was drawn.

    Raises:
        RuntimeError: OpenGL is not available.
        ValueError: the meshes are not on this machine, or no free start and goal are found.
    """
    if q_start is not None:
        q_start = check_limits(robot, q_start, "start")
    spec = needed_mesh_spec(robot, "a goal image needs")
    pairs = free_pairs(robot, world, np.random.default_rng(seed), distance, q_start)
    q_start, q_goal = next(pairs, (None, None))
    if q_start is None or q_goal is None:
        raise ValueError(
            f"found no free start and goal of '{robot.name}' {distance:g} rad apart; move the "
            "obstacles, or give another --start"
        )
    camera = front_camera(robot)
    picture = MeshRenderer(spec).picture(q_goal, camera)
    return Problem(
        name="random goal",
        robot=robot,
        world=world,
        self_model=self_model,
        cameras=(camera,),
        goal_images=(with_mask(picture),),
        q_start=q_start,
        true_goal=q_goal,
    )


def free_pairs(
    robot: Robot,
    world: World,
    rng: np.random.Generator,
    distance: float | None,
    q_start: np.ndarray | None = None,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of configurations (D,) inside the limits that C MuJoCo finds free, until none is found.

    Args:
        robot: whose they are.
        world: robot and obstacles.
        rng: of all that is drawn.
        distance: between the two [rad]; None draws both ends alike.
        q_start: (D,) the first of each pair [rad] or [m]; drawn if it is not given.
    """
    listed, alone = obstacle_list(world), world.by_spheres_alone()  # ends with some room
    for _ in range(MOST_DRAWS):
        starts = rng.uniform(robot.lower, robot.upper, (256, robot.num_joints))
        if q_start is not None:
            starts[:] = q_start
        if distance is None:
            goals = rng.uniform(robot.lower, robot.upper, starts.shape)
        else:
            step = rng.normal(size=starts.shape)
            goals = starts + distance * step / np.linalg.norm(step, axis=1, keepdims=True)
        inside = robot.is_continuous | ((goals > robot.lower) & (goals < robot.upper))
        goals = np.asarray(enforce_bounds(world, jnp.asarray(goals, jnp.float32)))
        free = [
            np.asarray(batch_is_free(alone, jnp.asarray(q, jnp.float32))) for q in (starts, goals)
        ]
        for i in np.flatnonzero(inside.all(1) & free[0] & free[1]):
            ends = starts[i].astype(np.float32), goals[i]
            if not any(contacts(robot, listed, q) for q in ends):
                yield ends


def front_camera(robot: Robot, azimuth_deg: float = AZIMUTH_DEG) -> Camera:
    """A camera that sees a robot's workspace, from the front if no other azimuth is given."""
    center, radius = workspace(robot)
    return orbit(
        azimuth_deg=azimuth_deg,
        elevation_deg=ELEVATION_DEG,
        distance=DISTANCE * radius,
        target=center.tolist(),
        height=IMAGE_PX,
        width=IMAGE_PX,
    )


def with_mask(picture: Picture) -> np.ndarray:
    """A goal image (H, W, 4) of a picture over black: the robot's straight colors, and its mask."""
    rgb = np.clip(picture.rgb / np.maximum(picture.alpha[..., None], 1e-3), 0.0, 1.0)
    return np.concatenate([rgb, picture.alpha[..., None]], axis=-1)
