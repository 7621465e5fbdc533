"""Mobile robots: kinematics, limits and the spheres that stand for them in collision checks."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from nrp_jax.scene.link_shapes import LinkShapes, link_shapes
from nrp_jax.scene.mobile_mjcf import mobile_mjcf
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import (
    Chain,
    Spheres,
    chain_from_model,
    link_poses,
    spheres_on_links,
)
from vrrt_jax.robots.limits import joint_ranges
from vrrt_jax.robots.self_collision import checked_pairs
from vrrt_jax.robots.sphere_cover import cover_primitives

FOOTPRINT = "footprint"  # geom of a round base that never tilts: a cylinder, not spheres
_NAMES = ("snake", "fetch")  # files in scenes/mobile_robots
# Half the side of the brick that one sphere covers [m], on the base (with the torso) and the links.
_GRAIN = {"snake": (0.02, 0.0125), "fetch": (0.03, 0.05)}


@pytree
class Footprint:
    """A round base that never tilts."""

    radius: jax.Array  # () [m]
    height: jax.Array  # () of its top [m]
    link: int = static()  # of the base


@pytree
class PlanarBoxes:
    """Flat rectangular links that move in the plane."""

    center: jax.Array  # (M, 2) in the links' frames [m]
    half: jax.Array  # (M, 2) half sides [m]
    link: tuple[int, ...] = static()  # (M,) the link of each box
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
    # What is checked against itself: flat boxes of a planar robot, or the shapes of another one.
    planar_boxes: PlanarBoxes | None
    shapes: LinkShapes | None
    footprint: Footprint | None  # of a round base
    feature_link: jax.Array  # (F,) i32, the link of each feature point
    feature_point: jax.Array  # (F, 3) in the link's frame [m]
    name: str = static()
    joint_names: tuple[str, ...] = static()  # (D,)
    link_names: tuple[str, ...] = static()  # (L,)
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


@single_precision
def link_features(robot: MobileRobot, q: jax.Array) -> jax.Array:
    """Points that describe the posture: tips of the snake's links, joint frames of the Fetch.

    Args:
        robot: from :func:`load_robot`.
        q: (D,) configuration [m] and [rad].

    Returns:
        (F, 3) world positions [m]; z is 0 for a planar robot.
    """
    pose = link_poses(robot.chain, q)[robot.feature_link]
    points = jnp.einsum("fij,fj->fi", pose[:, :3, :3], robot.feature_point) + pose[:, :3, 3]
    return points * jnp.array([1.0, 1.0, 0.0]) if robot.planar else points


batch_link_features = single_precision(jax.jit(jax.vmap(link_features, (None, 0))))


@single_precision
@functools.cache
def load_robot(name: str) -> MobileRobot:
    """Load "snake" (8 joints) or "fetch" (11 joints).

    Raises:
        ValueError: the name is unknown.
    """
    if name not in _NAMES:
        raise ValueError(f"unknown robot '{name}'; have: {', '.join(_NAMES)}")
    # The text is kept: exact scenes and pictures compile it with obstacles.
    xml = mobile_mjcf(name)
    model = mujoco.MjModel.from_xml_string(xml)
    chain, body_link, body_in_link = chain_from_model(model)
    planar = name == "snake"
    base_dim = 2 if planar else 3
    # Spheres stand for all geoms but the footprint, which is checked as the cylinder that it is.
    is_footprint = np.array([model.geom(g).name == FOOTPRINT for g in range(model.ngeom)])
    is_base = body_link[model.geom_bodyid] <= base_dim + (not planar)  # with the torso
    covered = np.flatnonzero(~is_footprint)
    grain = np.where(is_base, *_GRAIN[name])[covered]
    spheres, _ = cover_primitives(model, covered, grain, planar=planar)
    lower, upper = joint_ranges(model)
    is_hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    site_link, site_point = _points_on_links(
        model.site_bodyid, model.site_pos, body_link, body_in_link
    )
    return MobileRobot(
        chain=chain,
        lower=jnp.asarray(lower[base_dim:], jnp.float32),
        upper=jnp.asarray(upper[base_dim:], jnp.float32),
        is_continuous=jnp.asarray((model.jnt_limited == 0) & is_hinge),
        collision_spheres=spheres_on_links(spheres, body_link, body_in_link),
        planar_boxes=_planar_boxes(model, body_link, body_in_link) if planar else None,
        shapes=None if planar else link_shapes(model, covered, body_link, body_in_link),
        footprint=_footprint(model, body_link) if is_footprint.any() else None,
        feature_link=jnp.asarray(site_link, jnp.int32),
        feature_point=jnp.asarray(site_point, jnp.float32),
        name=name,
        joint_names=tuple(model.joint(j).name for j in range(model.njnt)),
        link_names=tuple(
            model.body(int(np.flatnonzero(body_link == link)[0])).name
            for link in range(chain.num_links)
        ),
        angular=tuple(is_hinge.tolist()),
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


def _planar_boxes(
    model: mujoco.MjModel, body_link: np.ndarray, body_in_link: np.ndarray
) -> PlanarBoxes:
    """The boxes that are checked against each other."""
    geoms = np.flatnonzero(model.geom_contype)
    link, center = _points_on_links(
        model.geom_bodyid[geoms], model.geom_pos[geoms], body_link, body_in_link
    )
    return PlanarBoxes(
        center=jnp.asarray(center[:, :2], jnp.float32),
        half=jnp.asarray(model.geom_size[geoms, :2], jnp.float32),
        link=tuple(link.tolist()),
        pairs=tuple(map(tuple, checked_pairs(model, geoms).tolist())),
    )


def _points_on_links(
    body: np.ndarray, point: np.ndarray, body_link: np.ndarray, body_in_link: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Links (n,) and points (n, 3) in their frames, of points (n, 3) in frames of bodies (n,)."""
    pose = body_in_link[body]
    return body_link[body], np.einsum("nij,nj->ni", pose[:, :3, :3], point) + pose[:, :3, 3]
