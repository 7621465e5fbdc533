"""A robot as the planner needs it: kinematics, limits and collision spheres."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.kinematics import Chain, chain_from_model
from vrrt_jax.core.types import Spheres
from vrrt_jax.robots import mjcf, pairs, spheres, text
from vrrt_jax.robots.paths import robot_names, robot_path


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
    wraps: np.ndarray  # (D,) bool, an unlimited hinge: q and q + 2 pi are the same
    home: np.ndarray  # (D,) a free configuration [rad] or [m]
    cover: Spheres  # cover the moving links: checked against obstacles
    cover_bodies: tuple[str, ...]  # body of each sphere of ``cover``, for messages
    thin: Spheres  # follow the surface of all links, the base too: checked against each other
    thin_bodies: tuple[str, ...]  # body of each sphere of ``thin``, for messages
    pairs: np.ndarray  # (P, 2) i32 indices into ``thin``: which are checked against each other
    allowed: tuple[tuple[str, str], ...]  # pairs of bodies that are never checked
    frozen: Mapping[str, float]  # joints of the file that are fixed, and where [rad] or [m]
    xml: str  # the collision model as MJCF; compiles by itself, without any mesh
    mesh_source: str | None  # name or file of the true geometry, see ``sources.mesh_spec``

    @property
    def num_joints(self) -> int:
        """D, the number of planned joints."""
        return len(self.joint_names)


def load_robot(name_or_path: str | Path, *, freeze: Mapping[str, float] | None = None) -> Robot:
    """Load a packaged robot, or any MJCF or URDF file with a fixed base.

    Collision geoms that are spheres are used as they are; others are covered with spheres, which
    takes some seconds.

    Args:
        name_or_path: a packaged robot, such as "panda", or a path.
        freeze: joints to fix, and where [rad] or [m].

    Raises:
        FileNotFoundError: the path leads to no file.
        ValueError: the name is unknown, the file is unreadable, a joint cannot be planned, or
            ``freeze`` names a joint that does not exist.
    """
    path = robot_path(name_or_path)
    model, home, frozen = _read(path, freeze)
    is_packaged = str(name_or_path) in robot_names()
    name = str(name_or_path) if is_packaged else path.stem
    found = spheres.spheres_of(model)
    allowed = pairs.excluded(model)
    spheres_text = functools.partial(
        text.collision_mjcf, model, name=name, cover=found.cover, thin=found.thin, home=home
    )
    if not found.has_kinds:
        draft = mujoco.MjModel.from_xml_string(spheres_text(allowed=allowed))
        allowed += pairs.always_touching(draft)
    xml = spheres_text(allowed=allowed)
    return _robot(
        model=mujoco.MjModel.from_xml_string(xml),
        name=name,
        allowed=allowed,
        frozen=frozen,
        xml=xml,
        mesh_source=name if is_packaged else str(path.resolve()),
    )


def _read(
    path: Path, freeze: Mapping[str, float] | None
) -> tuple[mujoco.MjModel, np.ndarray, dict[str, float]]:
    """The model with planned joints only, its home (D,), and the joints that were fixed."""
    spec = mjcf.read_spec(path)
    mjcf.strip_spec(spec, visuals=False)
    model = mjcf.compile_spec(spec, path)
    home = mjcf.home_positions(model)
    frozen = mjcf.frozen_positions(model, home, freeze)
    mjcf.freeze_joints(spec, frozen)
    model = mjcf.compile_spec(spec, path)
    mjcf.check_joints(model)
    return model, np.array([home[model.joint(j).name] for j in range(model.njnt)]), frozen


def _robot(*, model: mujoco.MjModel, **fields) -> Robot:
    """Assemble a robot from its compiled collision model."""
    chain, body_link, body_in_link = chain_from_model(model)
    limited = model.jnt_limited.astype(bool)
    labels = {}
    for label, group in (("cover", text.COVER), ("thin", text.THIN)):
        geoms = np.flatnonzero(model.geom_group == int(group["group"]))
        bodies = model.geom_bodyid[geoms]
        centre = np.einsum("nij,nj->ni", body_in_link[bodies, :3, :3], model.geom_pos[geoms])
        labels[label] = Spheres(
            link=jnp.asarray(body_link[bodies], jnp.int32),
            centre=jnp.asarray(centre + body_in_link[bodies, :3, 3], jnp.float32),
            radius=jnp.asarray(model.geom_size[geoms, 0], jnp.float32),
        )
        labels[f"{label}_bodies"] = tuple(model.body(body).name for body in bodies)
    base = next((b for b in range(1, model.nbody) if body_link[b] == 0), 0)
    link_bodies = [base, *model.jnt_bodyid]
    return Robot(
        chain=chain,
        joint_names=tuple(model.joint(j).name for j in range(model.njnt)),
        link_names=tuple(model.body(body).name for body in link_bodies),
        lower=np.where(limited, model.jnt_range[:, 0], -np.pi),
        upper=np.where(limited, model.jnt_range[:, 1], np.pi),
        wraps=~limited,
        home=model.key_qpos[0].copy(),
        pairs=pairs.checked_pairs(model),
        **labels,
        **fields,
    )
