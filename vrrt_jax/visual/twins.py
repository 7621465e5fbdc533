"""Kinematic twins: other joint angles with which almost all of an arm stands where it stood.

Where three joints in a row have axes through one point, as in a shoulder or a wrist, the first can
make half a turn, the second bend to the other side and the third make half a turn too. All that the
third joint carries is where it was; only the two links in between have turned. Images of twins
differ little, and joint angles a lot: no random change of some joints leads from one to the other.
"""

import dataclasses

import numpy as np

from vrrt_jax.robots.kinematics import Chain, batch_link_poses
from vrrt_jax.scene.world import World

SAME_POSE = 1e-3  # [m], and of the entries of a rotation
PERPENDICULAR = 1e-3  # cosine of what counts as a right angle


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flip:
    """Joints ``first`` to ``first + 2``: half a turn, a mirrored bend, half a turn."""

    first: int
    straight: float  # angle of the middle joint at which the axes of the other two align [rad]


def find_flips(chain: Chain) -> list[Flip]:
    """The flips of an arm, each checked on random configurations."""
    joints = len(chain.parents)
    axes = _axes(chain)
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (16, joints)).astype(np.float32)
    poses = np.asarray(batch_link_poses(chain, q))
    found = []
    for first in range(joints - 2):
        is_in_a_row = all(chain.parents[first + k] == first + k for k in (1, 2))
        if not (is_in_a_row and chain.is_hinge[first : first + 3].all()):
            continue
        a, bend, b = axes[first : first + 3]
        if max(abs(a @ bend), abs(b @ bend)) > PERPENDICULAR:
            continue
        flip = Flip(first=first, straight=float(np.arctan2(bend @ np.cross(b, a), a @ b)))
        moved = np.abs(np.asarray(batch_link_poses(chain, _flipped(flip, q))) - poses)
        # Only the two links that the first two joints move may stand elsewhere.
        others = np.delete(np.arange(chain.num_links), [first + 1, first + 2])
        if moved[:, others].max() < SAME_POSE:
            found.append(flip)
    return found


def _axes(chain: Chain) -> np.ndarray:
    """The joints' axes (D, 3) where all joints are 0; they have no length where joints slide."""
    # A quarter of a turn, seen from the parent's link: its skew part is the axis.
    constant, cosine, sine = (
        np.asarray(part)[:, :3, :3] for part in (chain.constant, chain.cosine, chain.sine)
    )
    quarter = (constant + sine) @ np.swapaxes(constant + cosine, 1, 2)
    skew = (quarter - np.swapaxes(quarter, 1, 2)) / 2
    local = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    zero = np.zeros((16, len(chain.parents)), np.float32)
    parents = np.asarray(batch_link_poses(chain, zero))[0, list(chain.parents), :3, :3]
    return np.einsum("jab,jb->ja", parents, local)


def _flipped(flip: Flip, q: np.ndarray) -> np.ndarray:
    """Configurations (n, D) after a flip; half turns go towards 0."""
    first, bend, last = flip.first, flip.first + 1, flip.first + 2
    q = q.copy()
    for joint in (first, last):
        q[:, joint] += np.where(q[:, joint] > 0, -np.pi, np.pi)
    mirrored = 2 * flip.straight - q[:, bend]
    q[:, bend] = (mirrored + np.pi) % (2 * np.pi) - np.pi
    return q


def twins(world: World, q: np.ndarray) -> np.ndarray:
    """The kinematic twins (m, D) of configurations (n, D) that are inside the limits."""
    every = q
    for flip in find_flips(world.chain):
        every = np.concatenate([every, _flipped(flip, every)])
    flipped = every[len(q) :]
    inside = (flipped >= np.asarray(world.lower)) & (flipped <= np.asarray(world.upper))
    return flipped[np.all(inside | np.asarray(world.is_continuous), axis=1)]
