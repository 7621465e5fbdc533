"""Mobile robots: kinematics, limits and the spheres that stand for them in collision checks."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import Chain, Spheres, chain_from_model, link_poses
from vrrt_jax.robots.packaged import scenes_dir

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
    xml = (scenes_dir() / "mobile_robots" / f"{name}.xml").read_text()
    model = mujoco.MjModel.from_xml_string(xml)
    chain, body_link, body_in_link = chain_from_model(model)
    planar = name == "snake"
    base_dim = 2 if planar else 3
    is_footprint = np.array([model.geom(g).name == FOOTPRINT for g in range(model.ngeom)])
    is_base = body_link[model.geom_bodyid] <= base_dim
    cover, owner = _cover(
        model,
        np.flatnonzero(~is_footprint),
        body_link,
        body_in_link,
        planar=planar,
        grain=np.where(is_base, *_GRAIN[name]),
    )
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
        collision_spheres=cover,
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


def _cover(
    model: mujoco.MjModel,
    geoms: np.ndarray,
    body_link: np.ndarray,
    body_in_link: np.ndarray,
    *,
    planar: bool,
    grain: np.ndarray,
) -> tuple[Spheres, np.ndarray]:
    """Spheres that cover some geoms, in the links' frames, and the geom of each."""
    link, center, radius, owner = [], [], [], []
    for geom in geoms:
        centers, radii = cover_geom(
            mujoco.mjtGeom(model.geom_type[geom]),
            model.geom_size[geom] * ([1, 1, 0] if planar else [1, 1, 1]),
            float(grain[geom]),
        )
        body = model.geom_bodyid[geom]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        in_body = centers @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        pose = body_in_link[body]
        center.append(in_body @ pose[:3, :3].T + pose[:3, 3])
        radius.append(radii)
        link += [body_link[body]] * len(centers)
        owner += [geom] * len(centers)
    spheres = Spheres(
        link=jnp.asarray(np.array(link), jnp.int32),
        center=jnp.asarray(np.concatenate(center), jnp.float32),
        radius=jnp.asarray(np.concatenate(radius), jnp.float32),
    )
    return spheres, np.array(owner)


def cover_geom(
    kind: mujoco.mjtGeom, size: np.ndarray, grain: float
) -> tuple[np.ndarray, np.ndarray]:
    """Spheres that cover a geom: a box brick by brick, a capsule along its axis.

    Args:
        kind: sphere, capsule or box.
        size: (3,) as MuJoCo's [m].
        grain: half the longest side of a brick, half the longest way between two spheres [m].

    Returns:
        Centers (n, 3) in the geom's frame and radii (n,).

    Raises:
        ValueError: another kind.
    """
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), size[:1]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        radius, half = size[:2]
        count = int(np.ceil(half / grain - 1e-6))
        centers = np.zeros((count + 1, 3))
        centers[:, 2] = np.linspace(-half, half, count + 1)
        return centers, np.full(count + 1, np.hypot(radius, half / count))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        counts = np.maximum(np.ceil(size / grain - 1e-6), 1).astype(int)
        ticks = [h * (2 * np.arange(n) + 1 - n) / n for h, n in zip(size, counts, strict=True)]
        centers = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        return centers, np.full(len(centers), np.linalg.norm(size / counts))
    raise ValueError(f"geom of kind {kind.name}: expected spheres, capsules and boxes")


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
