"""A robot as the planner needs it: kinematics, limits and collision spheres."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.data_file import of_file
from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots import frozen as frozen_joints
from vrrt_jax.robots import limits, mjcf, mjcf_writer, self_collision
from vrrt_jax.robots.kinematics import (
    BodySpheres,
    Chain,
    Spheres,
    batch_link_poses,
    chain_from_model,
    spheres_on_links,
)
from vrrt_jax.robots.packaged import robot_names, robot_path
from vrrt_jax.robots.polytopes import Polytope, polytopes_on_links
from vrrt_jax.robots.robot_spheres import RobotSpheres, spheres_of
from vrrt_jax.robots.self_collision_radii import fit_radii

_NUM_SAMPLES = 20_000  # configurations, to see which bodies never touch


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """A robot on a fixed base; an object of the host, see :func:`load_robot`.

    Letters: ``D`` joints, ``L = D + 1`` links: link 0 is the base, link ``j + 1`` is everything
    that joint ``j`` carries up to the next joint.
    """

    name: str
    chain: Chain
    joint_names: tuple[str, ...]  # (D,)
    link_names: tuple[str, ...]  # (L,) body of each link that its joint moves
    lower: np.ndarray  # (D,) [rad] or [m]; -pi for an unlimited hinge
    upper: np.ndarray  # (D,) [rad] or [m]; pi for an unlimited hinge
    is_continuous: np.ndarray  # (D,) bool, an unlimited hinge: q and q + 2 pi are the same
    home: np.ndarray  # (D,) a free configuration [rad] or [m]
    # These cover the moving links, and are checked against obstacles.
    collision_spheres: Spheres
    collision_sphere_bodies: tuple[str, ...]  # body of each collision sphere, for messages
    # These follow the surface of all links, the base too, and are checked against each other.
    self_collision_spheres: Spheres
    self_collision_sphere_bodies: tuple[str, ...]  # body of each of them, for messages
    self_collision_pairs: np.ndarray  # (P, 2) i32 indices of self-collision spheres to check
    ignored_pairs: tuple[tuple[str, str], ...]  # pairs of bodies that are never checked
    polytopes: tuple[Polytope, ...]  # contain the bodies more tightly than spheres; may be none
    frozen: Mapping[str, float]  # joints of the true geometry that are fixed [rad] or [m]
    xml: str  # the collision model as MJCF; compiles by itself, without any mesh
    mesh_source: str | None  # name or file of the true geometry, see ``mesh_sources.mesh_spec``
    folder: Path | None = None  # with its self-model; None for a robot of a file alone

    @property
    def num_joints(self) -> int:
        """D, the number of planned joints."""
        return len(self.joint_names)


@single_precision
def load_robot(name_or_path: str | Path, *, freeze: Mapping[str, float] | None = None) -> Robot:
    """Load a packaged robot, a folder of ``vrrt fit``, or any MJCF or URDF file with a fixed base.

    Collision geoms that are spheres are used as they are; others are covered with spheres, which
    takes some seconds.

    Args:
        name_or_path: a packaged robot, such as "panda", or the path of a file, or of a folder.
        freeze: joints to fix, and where [rad] or [m]. The fingers of packaged robots are fixed 4
            cm open; ``{"finger_joint1": 0.02, "finger_joint2": 0.02}`` closes the Panda's halfway.

    Raises:
        FileNotFoundError: the path leads to no file.
        ValueError: the name is unknown, the file is unreadable, a mesh is nowhere, a folder is not
            whole, a joint cannot be planned or its limits are unclear, or ``freeze`` names a joint
            that does not exist or puts one outside of its range.
    """
    path = robot_path(name_or_path)
    with of_file(path):
        return _loaded(name_or_path, path, freeze)


def _loaded(name_or_path: str | Path, path: Path, freeze: Mapping[str, float] | None) -> Robot:
    spec = mjcf.read_spec(path)
    model, home, frozen = _reduce(spec, path, freeze)
    spheres = spheres_of(model)
    mesh_source = str(path.resolve())
    name = str(name_or_path) if str(name_or_path) in robot_names() else path.stem
    if spheres.origin == "written":
        # The spheres stand for the robot of another file, which this file names.
        mesh_source, frozen_before = mjcf_writer.source_of(spec)
        name, frozen = spec.modelname, frozen_before | frozen
    fields = {
        "name": name,
        "mesh_source": mesh_source,
        "frozen": frozen,
    }
    write = functools.partial(
        mjcf_writer.collision_mjcf, model, collision=spheres.collision, home=home, **fields
    )
    self_collision_spheres, ignored_pairs = spheres.self_collision, self_collision.excluded(model)
    if spheres.origin != "written":
        self_collision_spheres, ignored_pairs = _prepare_self_collision(
            model, spheres, ignored_pairs, functools.partial(write, polytopes={})
        )
    xml = write(
        self_collision=self_collision_spheres,
        ignored_pairs=ignored_pairs,
        polytopes=spheres.polytopes,
    )
    return _robot(
        model=mujoco.MjModel.from_xml_string(xml),
        ignored_pairs=tuple(ignored_pairs),
        xml=xml,
        folder=None if path == Path(name_or_path).expanduser() else path.parent,
        **fields,
    )


def _prepare_self_collision(
    model: mujoco.MjModel,
    spheres: RobotSpheres,
    ignored_pairs: list[tuple[str, str]],
    write: Callable[..., str],
) -> tuple[BodySpheres, list[tuple[str, str]]]:
    """Self-collision spheres, and pairs of bodies to ignore, of a file that does not say.

    Args:
        model: the robot with its true geometry.
        spheres: of the robot.
        ignored_pairs: what the file excludes from contact.
        write: :func:`vrrt_jax.robots.mjcf_writer.collision_mjcf` but for the two results, and
            without polytopes.
    """
    if not self_collision.can_touch_itself(model):
        warnings.warn(
            "the contact bits of the robot let no two of its links touch: it is never checked "
            'against itself; give its geoms contype="1" conaffinity="1" to have that checked',
            stacklevel=3,
        )
    # Bodies that never touch in random configurations, or nearly always, need no check.
    sample = self_collision.sample_self_collisions(model, _NUM_SAMPLES, np.random.default_rng(0))
    ignored = sorted({*ignored_pairs, *self_collision.find_ignored_pairs(model, sample)})
    fitted = spheres.self_collision
    if spheres.origin == "fitted":
        fitted = fit_radii(model, fitted, sample, ignored, write)
    # Coarse spheres may touch where the true bodies do not: then no configuration would be free.
    draft = mujoco.MjModel.from_xml_string(write(self_collision=fitted, ignored_pairs=ignored))
    always = self_collision.always_touching(draft)
    if always:
        warnings.warn(
            f"the spheres of {'; '.join(' and '.join(pair) for pair in always)} touch at home, "
            "so that these bodies are never checked against each other; fit finer ones with: "
            "vrrt spheres",
            stacklevel=3,
        )
    return fitted, ignored + always


def workspace(robot: Robot) -> tuple[np.ndarray, float]:
    """Center (3,) and radius [m] of what the robot fills in random configurations."""
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.lower, robot.upper, (500, robot.num_joints))
    poses = np.asarray(batch_link_poses(robot.chain, jnp.asarray(q, jnp.float32)), np.float64)
    points = []
    for spheres_of_kind in (robot.collision_spheres, robot.self_collision_spheres):
        pose = poses[:, np.asarray(spheres_of_kind.link)]
        turned = np.einsum("nkij,kj->nki", pose[..., :3, :3], spheres_of_kind.center)
        points.append(turned + pose[..., :3, 3])
    low, high = np.quantile(np.concatenate(points, axis=1).reshape(-1, 3), [0.01, 0.99], axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def _reduce(
    spec: mujoco.MjSpec, path: Path, freeze: Mapping[str, float] | None
) -> tuple[mujoco.MjModel, np.ndarray, dict[str, float]]:
    """The model with planned joints only, its home (D,), and the joints that were fixed."""
    mjcf.warn_of_what_is_lost(spec)
    bad_ranges = limits.bad_ranges(spec, path)
    mjcf.strip_spec(spec, visuals=False)
    model = mjcf.compile_spec(spec, path)
    home = frozen_joints.home_positions(model)
    # A file that was written before says where the joints that it keeps are fixed.
    names = {model.joint(j).name for j in range(model.njnt)}
    _, before = mjcf_writer.source_of(spec)
    usual = {name: position for name, position in before.items() if name in names}
    frozen = frozen_joints.frozen_positions(model, home, usual | dict(freeze or {}))
    frozen_joints.freeze_joints(spec, frozen)
    model = mjcf.compile_spec(spec, path)
    limits.check_joints(model, bad_ranges)
    return model, np.array([home[model.joint(j).name] for j in range(model.njnt)]), frozen


def _robot(*, model: mujoco.MjModel, **fields) -> Robot:
    """Assemble a robot from its compiled collision model."""
    chain, body_link, body_in_link = chain_from_model(model)
    lower, upper = limits.joint_ranges(model)
    geoms_of_kind, spheres = {}, {}
    for label, kind in (
        ("collision_sphere", mjcf_writer.COLLISION_GEOM),
        ("self_collision_sphere", mjcf_writer.SELF_COLLISION_GEOM),
    ):
        geoms = np.flatnonzero(model.geom_group == int(kind["group"]))
        of_kind = BodySpheres(
            body=model.geom_bodyid[geoms],
            center=model.geom_pos[geoms],
            radius=model.geom_size[geoms, 0],
        )
        spheres[f"{label}s"] = spheres_on_links(of_kind, body_link, body_in_link)
        geoms_of_kind[label] = geoms
        spheres[f"{label}_bodies"] = tuple(model.body(body).name for body in of_kind.body)
    # The first body of the base gives link 0 its name.
    base = next((b for b in range(1, model.nbody) if body_link[b] == 0), 0)
    link_bodies = [base, *model.jnt_bodyid]
    return Robot(
        chain=chain,
        joint_names=tuple(model.joint(j).name for j in range(model.njnt)),
        link_names=tuple(model.body(body).name for body in link_bodies),
        lower=lower,
        upper=upper,
        is_continuous=model.jnt_limited == 0,
        home=model.key_qpos[0].copy(),
        polytopes=polytopes_on_links(model, body_link, body_in_link),
        self_collision_pairs=self_collision.checked_pairs(
            model, geoms_of_kind["self_collision_sphere"]
        ),
        **spheres,
        **fields,
    )
