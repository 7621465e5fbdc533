"""Mobile robots: kinematics, limits and the spheres that stand for them in collision checks."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from nrp_jax.scene.mobile_mjcf import mobile_mjcf
from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import (
    Chain,
    Spheres,
    chain_from_model,
    link_poses,
    spheres_on_links,
)
from vrrt_jax.robots.sphere_cover import cover_primitives

FOOTPRINT = "footprint"  # geom of a round base that never tilts: a cylinder, not spheres
_NAMES = ("snake", "fetch")  # files in scenes/mobile_robots
# Half the side of the bricks that a sphere covers [m], on the base and on the links.
_GRAIN = {"snake": (0.02, 0.0125), "fetch": (0.05, 0.05)}


@pytree
class Footprint:
    """A round base that never tilts."""

    radius: jax.Array  # () [m]
    height: jax.Array  # () of its top [m]
    link: int = static()


@pytree
class PlanarBoxes:
    """Flat rectangular links that move in the plane."""

    center: jax.Array  # (M, 2) in the links' frames [m]
    half: jax.Array  # (M, 2) half sides [m]
    link: tuple[int, ...] = static()  # (M,)
    pairs: tuple[tuple[int, int], ...] = static()  # (P, 2) which are checked against each other


@pytree
class MobileRobot:
    """A robot on a moving base; configurations start with the base: x, y and perhaps theta.

    Letters: ``D`` joints with the base's, ``A`` those after the base, ``F`` feature points.
    """

    chain: Chain
    lower: jax.Array  # (A,) [rad] or [m]
    upper: jax.Array  # (A,) [rad] or [m]
    is_continuous: jax.Array  # (D,) bool, joints that turn for ever
    collision_spheres: Spheres  # cover the robot but for its footprint: checked against obstacles
    self_collision_pairs: (
        jax.Array
    )  # (P, 2) i32 indices into ``cover``: which are checked against each other
    plates: PlanarBoxes | None  # checked against each other instead, if there are any
    footprint: Footprint | None
    feature_link: jax.Array  # (F,) i32
    feature_point: jax.Array  # (F, 3) in the link's frame [m]
    name: str = static()
    joint_names: tuple[str, ...] = static()  # (D,)
    angular: tuple[bool, ...] = static()  # (D,) joints that turn; the others slide
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


batch_link_features = jax.jit(jax.vmap(link_features, (None, 0)))


@functools.cache
def load_robot(name: str) -> MobileRobot:
    """Load "snake" (8 joints) or "fetch" (11 joints).

    Raises:
        ValueError: the name is unknown.
    """
    if name not in _NAMES:
        raise ValueError(f"unknown robot '{name}'; have: {', '.join(_NAMES)}")
    xml = mobile_mjcf(name)
    model = mujoco.MjModel.from_xml_string(xml)
    chain, body_link, body_in_link = chain_from_model(model)
    planar = name == "snake"
    base_dim = 2 if planar else 3
    is_footprint = np.array([model.geom(g).name == FOOTPRINT for g in range(model.ngeom)])
    is_base = body_link[model.geom_bodyid] <= base_dim
    # Spheres stand for all but the footprint, which is checked as the cylinder that it is.
    covered = np.flatnonzero(~is_footprint)
    grain = np.where(is_base, *_GRAIN[name])[covered]
    spheres, owner = cover_primitives(model, covered, grain, planar=planar)
    limited = model.jnt_limited.astype(bool)
    angular = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    lower = np.where(limited, model.jnt_range[:, 0], -np.pi)[base_dim:]
    upper = np.where(limited, model.jnt_range[:, 1], np.pi)[base_dim:]
    site_pose = body_in_link[model.site_bodyid]
    points = np.einsum("nij,nj->ni", site_pose[:, :3, :3], model.site_pos) + site_pose[:, :3, 3]
    return MobileRobot(
        chain=chain,
        lower=jnp.asarray(lower, jnp.float32),
        upper=jnp.asarray(upper, jnp.float32),
        is_continuous=jnp.asarray(~limited & angular),
        collision_spheres=spheres_on_links(spheres, body_link, body_in_link),
        self_collision_pairs=jnp.asarray(
            _checked_pairs(model, owner[: 0 if planar else None]), jnp.int32
        ),
        plates=_plates(model, body_link, body_in_link) if planar else None,
        footprint=_footprint(model, body_link) if is_footprint.any() else None,
        feature_link=jnp.asarray(body_link[model.site_bodyid], jnp.int32),
        feature_point=jnp.asarray(points, jnp.float32),
        name=name,
        joint_names=tuple(model.joint(j).name for j in range(model.njnt)),
        angular=tuple(angular.tolist()),
        planar=planar,
        xml=xml,
    )


def _footprint(model: mujoco.MjModel, body_link: np.ndarray) -> Footprint:
    geom = model.geom(FOOTPRINT)
    radius, half = geom.size[:2]
    return Footprint(
        radius=jnp.float32(radius),
        height=jnp.float32(geom.pos[2] + half),
        link=int(body_link[geom.bodyid[0]]),
    )


def _plates(model: mujoco.MjModel, body_link: np.ndarray, body_in_link: np.ndarray) -> PlanarBoxes:
    geoms = np.flatnonzero(model.geom_contype)
    body = model.geom_bodyid[geoms]
    center = np.einsum("nij,nj->ni", body_in_link[body, :3, :3], model.geom_pos[geoms])
    return PlanarBoxes(
        center=jnp.asarray((center + body_in_link[body, :3, 3])[:, :2], jnp.float32),
        half=jnp.asarray(model.geom_size[geoms, :2], jnp.float32),
        link=tuple(body_link[body].tolist()),
        pairs=tuple(map(tuple, _checked_pairs(model, geoms).tolist())),
    )


def _checked_pairs(model: mujoco.MjModel, owner: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of spheres whose geoms may collide by MuJoCo's own rules."""
    first, second = np.triu_indices(len(owner), 1)
    a, b = owner[first], owner[second]
    wanted = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
        model.geom_contype[b] & model.geom_conaffinity[a]
    )
    body_a, body_b = model.geom_bodyid[a], model.geom_bodyid[b]
    parent = model.body_parentid
    related = (body_a == body_b) | (parent[body_a] == body_b) | (parent[body_b] == body_a)
    signature = (np.minimum(body_a, body_b) << 16) + np.maximum(body_a, body_b)
    keep = (wanted > 0) & ~related & ~np.isin(signature, model.exclude_signature)
    return np.stack([first[keep], second[keep]], axis=1)
