"""Forward kinematics as a chain of 4x4 matrix products.

Each product is written as four multiply-adds behind a fusion barrier. Without the barrier XLA's CPU
backend may recompute the chain once for every output element, as it does with ``mjx.kinematics``
(thousands of times slower inside a plain ``jit``); with ``dot`` instead the chain is safe too, but
XLA has no fast path for batches of 4x4 matrices (13 times slower for 1,024 configurations).
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree, static


@pytree
class Chain:
    """The moving part of a robot: link 0 is everything welded to the world.

    Link ``j + 1`` is what joint ``j`` moves. Its transform to its parent's frame is
    ``constant + cos(q) cosine + sin(q) sine + q slide``.
    """

    constant: jax.Array  # (D, 4, 4)
    cosine: jax.Array  # (D, 4, 4)
    sine: jax.Array  # (D, 4, 4)
    slide: jax.Array  # (D, 4, 4)
    parents: tuple[int, ...] = static()  # (D,) parent link of link j + 1

    @property
    def num_links(self) -> int:
        """L, with the fixed link 0."""
        return len(self.parents) + 1

    @property
    def is_hinge(self) -> np.ndarray:
        """(D,) bool, which joints turn; the others slide. On the host."""
        return ~np.any(np.asarray(self.slide), axis=(1, 2))


@pytree
class Spheres:
    """Collision spheres bound to links."""

    link: jax.Array  # (n,) i32
    center: jax.Array  # (n, 3) in the link's frame [m]
    radius: jax.Array  # (n,) [m]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodySpheres:
    """Spheres bound to bodies of a MuJoCo model, on the host."""

    body: np.ndarray  # (n,) int
    center: np.ndarray  # (n, 3) in the frame of the body [m]
    radius: np.ndarray  # (n,) [m]


@single_precision
def link_poses(chain: Any, q: jax.Array) -> jax.Array:
    """World poses of all links.

    Args:
        chain: a robot or a world, or the :class:`Chain` of one.
        q: (D,) joint positions [rad] or [m].

    Returns:
        (L, 4, 4) link-to-world transforms.

    Raises:
        ValueError: q has another shape, which is known while functions are traced too.
    """
    chain, q = getattr(chain, "chain", chain), jnp.asarray(q)
    if q.shape != (len(chain.parents),):
        raise ValueError(
            f"q has shape {q.shape}; expected ({len(chain.parents)},), a number for each joint; "
            "jax.vmap takes several"
        )
    angle = q[:, None, None]
    local = (
        chain.constant
        + jnp.cos(angle) * chain.cosine
        + jnp.sin(angle) * chain.sine
        + angle * chain.slide
    )
    # Parents come before their children: each link's pose follows from a pose known already.
    poses = [jnp.eye(4, dtype=local.dtype)]
    for j, parent in enumerate(chain.parents):
        poses.append(local[j] if parent == 0 else _product(poses[parent], local[j]))
    return jnp.stack(poses)


# Of q (n, D), for the host.
batch_link_poses = single_precision(jax.jit(jax.vmap(link_poses, (None, 0))))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    product = sum(a[:, k : k + 1] * b[k : k + 1] for k in range(4))
    return jax.lax.optimization_barrier(product)


def placement(link: np.ndarray, points: np.ndarray, num_links: int) -> np.ndarray:
    """The matrix (L * 4, n) with which :func:`place` takes poses to points on links.

    One product of matrices places a whole batch; gathering a pose for every point costs XLA's CPU
    backend five times as much.

    Args:
        link: (n,) link of each point.
        points: (n, 3) in the links' frames [m].
        num_links: L.
    """
    n = len(link)
    matrix = np.zeros((num_links, 4, n), np.float32)
    matrix[link, :3, np.arange(n)] = points
    matrix[link, 3, np.arange(n)] = 1.0
    return matrix.reshape(num_links * 4, n)


def place(matrix: jax.Array, poses: jax.Array) -> jax.Array:
    """World positions (3, n) of points on links posed by (L, 4, 4); see :func:`placement`."""
    return jnp.moveaxis(poses[:, :3], 1, 0).reshape(3, -1) @ matrix


def lever_arms(
    chain: Chain, link: np.ndarray, points: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """How far points on links move at most while one joint moves by one.

    For a hinge that is the largest distance from its axis that the joints between can give a point.
    It is bounded by the lengths from axis to axis, and so holds for all configurations.

    Args:
        chain: L links.
        link: (n,) link of each point.
        points: (n, 3) in the links' frames [m].
        lower: (D,) limits of the joints.
        upper: (D,) limits of the joints.

    Returns:
        (D, n) [m/rad], or [m/m] for slides; 0 for joints that do not carry the point.
    """
    constant, cosine, sine, slide = (
        np.asarray(t, np.float64) for t in (chain.constant, chain.cosine, chain.sine, chain.slide)
    )
    num_joints, is_slide = len(chain.parents), np.any(slide != 0, axis=(1, 2))
    anchor = np.zeros((num_joints, 3))  # a point on each axis, in the frame of the joint's link
    travel = np.where(is_slide, np.maximum(np.abs(lower), np.abs(upper)), 0.0)
    for j in range(num_joints):
        # What cosine and sine leave where it is lies on the axis.
        turning = np.concatenate([cosine[j], sine[j]])
        anchor[j] = np.linalg.lstsq(turning[:, :3], -turning[:, 3], rcond=1e-6)[0]
    arms = np.zeros((num_joints, len(link)))
    for k, (carrier, point) in enumerate(zip(link, points, strict=True)):
        # From the point towards the base, joint by joint; ``rest`` is what lies beyond the joint
        # before, and ``place`` where that joint's axis passes.
        joint, place, rest = carrier - 1, point, 0.0
        while joint >= 0:
            offset = place - anchor[joint]
            # The part of the offset across the axis: what the joint's turn moves.
            across = np.linalg.norm(cosine[joint][:3, :3] @ offset)
            arms[joint, k] = 1.0 if is_slide[joint] else across + rest
            rest += np.linalg.norm(offset) + travel[joint]
            place = (constant[joint] @ [*anchor[joint], 1.0])[:3]
            joint = chain.parents[joint] - 1
    return arms


def body_links(model: mujoco.MjModel) -> np.ndarray:
    """The link (nbody,) that every body belongs to: that of its last joint, or its parent's."""
    link = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        link[body] = first + count if count else link[model.body_parentid[body]]
    return link


@single_precision
def chain_from_model(model: mujoco.MjModel) -> tuple[Chain, np.ndarray, np.ndarray]:
    """Read the chain from a model with hinge and slide joints on a fixed base.

    Args:
        model: a compiled robot; joint order gives the order of q.

    Returns:
        The chain; the link (nbody,) of every body; the pose (nbody, 4, 4) of every body in its
        link's frame.

    Raises:
        ValueError: a joint is free or ball, or a body has several joints.
    """
    num_joints = model.njnt
    terms = np.zeros((4, num_joints, 4, 4))
    parents = [0] * num_joints
    body_link = body_links(model)
    body_in_link = np.tile(np.eye(4), (model.nbody, 1, 1))
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        body_in_parent = _pose(model.body_pos[body], model.body_quat[body])
        offset = body_in_link[parent] @ body_in_parent
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        if count == 0:
            body_in_link[body] = offset
            continue
        if count > 1:
            raise ValueError(
                f"body '{model.body(body).name}' has {count} joints; give each joint a body of "
                "its own"
            )
        terms[:, first] = _joint_terms(model, first, offset)
        parents[first] = int(body_link[parent])
    arrays = [jnp.asarray(t, jnp.float32) for t in terms]
    chain = Chain(
        constant=arrays[0],
        cosine=arrays[1],
        sine=arrays[2],
        slide=arrays[3],
        parents=tuple(parents),
    )
    return chain, body_link, body_in_link


def spheres_on_links(
    spheres: BodySpheres, body_link: np.ndarray, body_in_link: np.ndarray
) -> Spheres:
    """Bind spheres to links instead of bodies.

    Args:
        spheres: n spheres of a model's bodies.
        body_link: (nbody,) from :func:`chain_from_model`.
        body_in_link: (nbody, 4, 4) from :func:`chain_from_model`.
    """
    pose = body_in_link[spheres.body]
    center = np.einsum("nij,nj->ni", pose[:, :3, :3], spheres.center) + pose[:, :3, 3]
    return Spheres(
        link=jnp.asarray(body_link[spheres.body], jnp.int32),
        center=jnp.asarray(center, jnp.float32),
        radius=jnp.asarray(spheres.radius, jnp.float32),
    )


def _pose(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, np.float64))
    pose[:3, :3] = rotation.reshape(3, 3)
    pose[:3, 3] = position
    return pose


def _joint_terms(model: mujoco.MjModel, joint: int, offset: np.ndarray) -> np.ndarray:
    """Constant, cosine, sine and slide terms (4, 4, 4) of offset @ motion(q - q_ref)."""
    kind, axis = model.jnt_type[joint], model.jnt_axis[joint]
    anchor, reference = model.jnt_pos[joint], model.qpos0[model.jnt_qposadr[joint]]
    constant, cosine, sine, slide = np.eye(4), np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    if kind == mujoco.mjtJoint.mjJNT_SLIDE:
        slide[:3, 3] = axis
        constant[:3, 3] = -reference * axis
    elif kind == mujoco.mjtJoint.mjJNT_HINGE:
        # Rodrigues: R = aa' + cos (I - aa') + sin [a]x, about the anchor: x -> R (x - p) + p
        along, cross = np.outer(axis, axis), np.cross(np.eye(3), axis)
        for term, rotation in ((constant, along), (cosine, np.eye(3) - along), (sine, cross)):
            term[:3, :3] = rotation
            term[:3, 3] = -rotation @ anchor
        constant[:3, 3] += anchor
        # cos(q - q0) and sin(q - q0), expanded.
        c, s = np.cos(reference), np.sin(reference)
        cosine, sine = c * cosine - s * sine, s * cosine + c * sine
    else:
        raise ValueError(
            f"joint '{model.joint(joint).name}' is a {mujoco.mjtJoint(kind).name[6:].lower()} "
            "joint; only hinge and slide joints on a fixed base can be planned: fix the base, or "
            "replace the joint by hinges and slides"
        )
    return np.stack([offset @ term for term in (constant, cosine, sine, slide)])
