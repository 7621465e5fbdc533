"""Mobile robots: kinematics, limits and the spheres that stand for them in collision checks."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import vrrt_jax.core
from vrrt_jax.core.kinematics import Chain, chain_from_model, link_poses
from vrrt_jax.core.types import Spheres, pytree, static

OBSTACLES = 4  # bit of conaffinity: the geom is checked against obstacles
_FILES = {"snake": "snake", "fetch": "fetch_mobile"}  # folders in scenes/robots
_GRAIN = {"snake": 0.0125, "fetch": 0.05}  # half the side of the cubes that spheres cover [m]


@pytree
class MobileRobot:
    """A robot on a moving base; configurations start with the base: x, y and perhaps theta.

    Letters: ``D`` joints with the base's, ``A`` those after the base, ``F`` feature points.
    """

    chain: Chain
    lower: jax.Array  # (A,) [rad] or [m]
    upper: jax.Array  # (A,) [rad] or [m]
    wraps: jax.Array  # (D,) bool, joints that turn for ever
    cover: Spheres  # cover the robot: checked against obstacles
    thin: Spheres  # checked against each other
    pairs: jax.Array  # (P, 2) i32 indices into ``thin``: which of them
    feature_link: jax.Array  # (F,) i32
    feature_point: jax.Array  # (F, 3) in the link's frame [m]
    name: str = static()
    joint_names: tuple[str, ...] = static()  # (D,)
    planar: bool = static()  # heights do not matter
    xml: str = static()  # MJCF of primitive geoms

    @property
    def num_joints(self) -> int:
        """D."""
        return len(self.joint_names)

    @property
    def base_dim(self) -> int:
        """2 for a base that slides, 3 for one that turns too."""
        return self.num_joints - self.lower.shape[0]


def link_features(robot: MobileRobot, q: jax.Array) -> jax.Array:
    """Points that describe the posture: tips of the snake's links, frames of the Fetch's.

    Args:
        robot: from :func:`load_robot`.
        q: (D,) configuration.

    Returns:
        (F, 3) world positions [m]; z is 0 for a planar robot.
    """
    pose = link_poses(robot.chain, q)[robot.feature_link]
    points = jnp.einsum("fij,fj->fi", pose[:, :3, :3], robot.feature_point) + pose[:, :3, 3]
    return points * jnp.array([1.0, 1.0, 0.0]) if robot.planar else points


@functools.cache
def load_robot(name: str) -> MobileRobot:
    """Load "snake" (8 joints) or "fetch" (11 joints).

    Raises:
        ValueError: the name is unknown.
    """
    if name not in _FILES:
        raise ValueError(f"unknown robot '{name}'; have: {', '.join(_FILES)}")
    xml = (_scenes_dir() / "robots" / _FILES[name] / "robot.xml").read_text()
    model = mujoco.MjModel.from_xml_string(xml)
    chain, body_link, body_in_link = chain_from_model(model)
    planar = name == "snake"
    cover, cover_geoms = _spheres(
        model, body_link, body_in_link, planar, _GRAIN[name], model.geom_conaffinity & OBSTACLES > 0
    )
    thin, thin_geoms = _spheres(
        model, body_link, body_in_link, planar, _GRAIN[name], model.geom_contype > 0
    )
    base_dim = 2 if planar else 3
    limited = model.jnt_limited.astype(bool)
    lower = np.where(limited, model.jnt_range[:, 0], -np.pi)
    upper = np.where(limited, model.jnt_range[:, 1], np.pi)
    site_link = body_link[model.site_bodyid]
    site_pose = body_in_link[model.site_bodyid]
    points = np.einsum("nij,nj->ni", site_pose[:, :3, :3], model.site_pos) + site_pose[:, :3, 3]
    return MobileRobot(
        chain=chain,
        lower=jnp.asarray(lower[base_dim:], jnp.float32),
        upper=jnp.asarray(upper[base_dim:], jnp.float32),
        wraps=jnp.asarray(~limited & (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)),
        cover=cover,
        thin=thin,
        pairs=jnp.asarray(_checked(model, thin_geoms), jnp.int32),
        feature_link=jnp.asarray(site_link, jnp.int32),
        feature_point=jnp.asarray(points, jnp.float32),
        name=name,
        joint_names=tuple(model.joint(j).name for j in range(model.njnt)),
        planar=planar,
        xml=xml,
    )


def _scenes_dir() -> Path:
    """``scenes/`` of a checkout, or its copy inside an installed wheel."""
    package = Path(vrrt_jax.core.__file__).resolve().parents[1]
    installed = package / "_scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def _spheres(
    model: mujoco.MjModel,
    body_link: np.ndarray,
    body_in_link: np.ndarray,
    planar: bool,
    grain: float,
    wanted: np.ndarray,
) -> tuple[Spheres, np.ndarray]:
    """Spheres that cover the wanted geoms, in the links' frames, and the geom of each."""
    link, centre, radius, owner = [], [], [], []
    for geom in np.flatnonzero(wanted):
        centres, radii = _cover_geom(model, geom, planar, grain)
        body = model.geom_bodyid[geom]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        in_body = centres @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        pose = body_in_link[body]
        centre.append(in_body @ pose[:3, :3].T + pose[:3, 3])
        radius.append(radii)
        link += [body_link[body]] * len(centres)
        owner += [geom] * len(centres)
    spheres = Spheres(
        link=jnp.asarray(np.array(link), jnp.int32),
        centre=jnp.asarray(np.concatenate(centre), jnp.float32),
        radius=jnp.asarray(np.concatenate(radius), jnp.float32),
    )
    return spheres, np.array(owner)


def _cover_geom(
    model: mujoco.MjModel, geom: int, planar: bool, grain: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 3) and radii (n,) of spheres that cover a box or a sphere, in its frame."""
    size = model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), size[:1]
    half = size * [1, 1, 0] if planar else size
    return cover_box(half, grain)


def cover_box(half: np.ndarray, grain: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut a box into bricks of half sides up to ``grain``, and put a sphere around each.

    Args:
        half: (3,) half sides [m].
        grain: [m].

    Returns:
        Centres (n, 3) in the box's frame and radii (n,).
    """
    counts = np.maximum(np.ceil(half / grain - 1e-6), 1).astype(int)
    ticks = [h * (2 * np.arange(n) + 1 - n) / n for h, n in zip(half, counts, strict=True)]
    centres = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    return centres, np.full(len(centres), np.linalg.norm(half / counts))


def _checked(model: mujoco.MjModel, owner: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of spheres whose geoms may collide by MuJoCo's own rules."""
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    first, second = np.triu_indices(len(owner), 1)
    a, b = owner[first], owner[second]
    masks = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
        model.geom_contype[b] & model.geom_conaffinity[a]
    )
    body_a, body_b = model.geom_bodyid[a], model.geom_bodyid[b]
    weld_a, weld_b = model.body_weldid[body_a], model.body_weldid[body_b]
    parent_a = model.body_weldid[model.body_parentid[weld_a]]
    parent_b = model.body_weldid[model.body_parentid[weld_b]]
    adjacent = (weld_a == weld_b) | (parent_a == weld_b) | (parent_b == weld_a)
    apart = [
        (int(i), int(j)) in excluded or (int(j), int(i)) in excluded
        for i, j in zip(body_a, body_b, strict=True)
    ]
    keep = (masks > 0) & ~adjacent & ~np.array(apart, bool)
    return np.stack([first[keep], second[keep]], axis=1)
