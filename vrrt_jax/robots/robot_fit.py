"""Fit the collision spheres of a robot to its true geometry and write them as MJCF."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import mujoco
import numpy as np

from vrrt_jax.robots import mjcf_writer, sphere_fit
from vrrt_jax.robots.convex_parts import contain_surface
from vrrt_jax.robots.geom_pieces import collision_pieces
from vrrt_jax.robots.kinematics import BodySpheres
from vrrt_jax.robots.mesh_sources import install_hint, mesh_spec
from vrrt_jax.robots.polytopes import outer_polytopes
from vrrt_jax.robots.robot import Robot
from vrrt_jax.robots.robot_spheres import spheres_of
from vrrt_jax.robots.self_collision import (
    SelfCollisions,
    checked_pairs,
    excluded,
    find_ignored_pairs,
    sample_self_collisions,
)
from vrrt_jax.robots.self_collision_fit import fit_radii_to_sample, fit_to_sample

_CONFIGURATIONS = 40_000  # for self-collision
_LEAF = 3e-4  # [m] size of the smallest triangle when the cover is proven
_PROBES = (2, 8)  # spheres with which the bodies are compared
_MOVES = 24  # of spheres of each body, to where they save more false alarms
_SELF_SPACING = 0.05  # [m] of the longest side of a body, for each self-collision sphere
_MOST_SELF = 12  # self-collision spheres of one body


def fit_spheres(
    robot: Robot,
    *,
    num_spheres: int = 64,
    self_collision: Literal["new", "radii", "kept"] = "new",
    seed: int = 0,
    progress: Callable[[str], None] = lambda line: None,
) -> str:
    """Fit spheres anew; takes some minutes.

    Collision spheres contain every point of the surface of the moving bodies, so that no contact
    with an obstacle is missed. Self-collision spheres are others: their places and radii agree best
    with the true geometry in self-collision.

    Args:
        robot: its kinematics and home are kept, its spheres are not used.
        num_spheres: collision spheres on all moving bodies together.
        self_collision: fit new spheres for it; or only the radii of the robot's own; or keep these
            as they are. The pairs of bodies to ignore are new with new spheres only.
        seed: of all random choices.
        progress: called with a line of text now and then.

    Returns:
        The collision model as MJCF, see :attr:`vrrt_jax.robots.Robot.xml`.

    Raises:
        ValueError: the true geometry is nowhere on this machine, or there are fewer spheres than
            bodies.
    """
    spec = mesh_spec(robot, visuals=False)
    if spec is None:
        raise ValueError(
            f"cannot fit spheres: the meshes of robot '{robot.name}' are not on this machine: "
            f"{install_hint(robot.mesh_source)}"
        )
    model = spec.compile()
    rng = np.random.default_rng(seed)
    pieces = collision_pieces(model)
    samples = sphere_fit.sample_bodies(model, pieces, rng)
    moving = [body for body in pieces if model.body_weldid[body]]
    progress(f"fitting {num_spheres} spheres to {len(moving)} moving bodies")
    fitted = _share_out({body: samples[body] for body in moving}, num_spheres, rng, progress)
    # The descent saw samples only: grow the spheres until they provably contain the surface.
    proven = {
        body: contain_surface(pieces[body], *fitted[body], leaf=_LEAF) for body in sorted(fitted)
    }
    # Randomness of its own, so that another number of collision spheres changes nothing here.
    rng = np.random.default_rng([seed, 1])
    sample = sample_self_collisions(model, _CONFIGURATIONS, rng)
    own = mujoco.MjModel.from_xml_string(robot.xml)
    ignored_pairs = find_ignored_pairs(model, sample) if self_collision == "new" else excluded(own)
    write = functools.partial(
        mjcf_writer.collision_mjcf,
        model,
        name=robot.name,
        collision=_collect(proven),
        home=robot.home,
        mesh_source=robot.mesh_source,
        frozen=robot.frozen,
        comment=_comment(robot.name, num_spheres, seed),
    )
    write = functools.partial(write, ignored_pairs=ignored_pairs)
    draft = functools.partial(write, polytopes={})
    if self_collision == "new":
        thin = _self_collision_spheres(model, samples, sample, draft, rng)
    else:
        thin = _own_spheres(model, own)
        if self_collision == "radii":
            thin = _with_radii(model, thin, sample, draft)
    progress(f"{len(thin.body)} spheres take part in self-collision")
    return write(self_collision=thin, polytopes=outer_polytopes(model))


def _self_collision_spheres(
    model: mujoco.MjModel,
    samples: dict[int, sphere_fit.BodySamples],
    sample: SelfCollisions,
    write: Callable[..., str],
    rng: np.random.Generator,
) -> BodySpheres:
    """Spheres on the bodies that may touch another one, fitted to a sample of self-collisions."""
    # One dot on each body tells which bodies MuJoCo checks against which.
    bodies = np.array(sorted(samples))
    dots = BodySpheres(body=bodies, center=np.zeros((len(bodies), 3)), radius=0.01 + 0.0 * bodies)
    draft = mujoco.MjModel.from_xml_string(write(self_collision=dots))
    geoms = np.flatnonzero(_is_self_collision(draft))
    checked = bodies[checked_pairs(draft, geoms)]
    # Covers to begin with; the fit shrinks them.
    covers = {}
    for body in np.unique(checked):
        length = np.ptp(samples[body].surface, axis=0).max()
        num = int(np.clip(round(length / _SELF_SPACING), 1, _MOST_SELF))
        covers[body] = sphere_fit.fit_body(samples[body], num, rng)[:2]
    if not covers:
        return BodySpheres(body=bodies[:0], center=np.zeros((0, 3)), radius=np.zeros(0))
    spheres = _collect(covers)
    pairs = checked_pairs(draft, geoms[np.searchsorted(bodies, spheres.body)])
    return fit_to_sample(model, spheres, pairs, sample.q, _truth(sample, checked))


def _own_spheres(model: mujoco.MjModel, own: mujoco.MjModel) -> BodySpheres:
    """The self-collision spheres of a robot's own model, on the bodies of the one with meshes."""
    kept = spheres_of(own).self_collision
    body = np.array([model.body(own.body(k).name).id for k in kept.body], int)
    return dataclasses.replace(kept, body=body)


def _with_radii(
    model: mujoco.MjModel, spheres: BodySpheres, sample: SelfCollisions, write: Callable[..., str]
) -> BodySpheres:
    """Self-collision spheres with the radii that agree best with a sample."""
    draft = mujoco.MjModel.from_xml_string(write(self_collision=spheres))
    pairs = checked_pairs(draft, np.flatnonzero(_is_self_collision(draft)))
    truth = _truth(sample, spheres.body[pairs])
    return fit_radii_to_sample(model, spheres, pairs, sample.q, truth)


def _is_self_collision(model: mujoco.MjModel) -> np.ndarray:
    return model.geom_group == int(mjcf_writer.SELF_COLLISION_GEOM["group"])


def _truth(sample: SelfCollisions, pairs: np.ndarray) -> np.ndarray:
    """Whether any of some pairs of bodies (P, 2) touches in each configuration, (m,) bool."""
    checked = {(min(pair), max(pair)) for pair in pairs.tolist()}
    return np.array([bool(touching & checked) for touching in sample.touching])


def _comment(name: str, num_spheres: int, seed: int) -> str:
    return f"""
  Written by the command `vrrt spheres` for {name}: {num_spheres} collision spheres, seed {seed}.
  cover: contain the convex collision meshes of the moving bodies; checked against obstacles.
  thin: touch each other where the meshes do, as nearly as so many spheres can.
  polytope: contain the convex collision meshes of all bodies, more tightly than spheres.
  exclude: bodies that share a joint, and bodies whose meshes touch in none of
  {_CONFIGURATIONS:,} random configurations.
"""


def _collect(spheres: dict[int, tuple[np.ndarray, np.ndarray]]) -> BodySpheres:
    return BodySpheres(
        body=np.repeat(list(spheres), [len(radii) for _, radii in spheres.values()]),
        center=np.vstack([centers for centers, _ in spheres.values()]),
        radius=np.hstack([radii for _, radii in spheres.values()]),
    )


def _share_out(
    samples: dict[int, sphere_fit.BodySamples],
    num_spheres: int,
    rng: np.random.Generator,
    progress: Callable[[str], None],
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Give spheres to the bodies where they save most false alarms, and fit them."""
    if num_spheres < len(samples):
        raise ValueError(
            f"num_spheres is {num_spheres}; expected at least one for each of the {len(samples)} "
            "moving bodies"
        )
    # Two numbers of spheres tell how the volume of a body's false alarms falls with their number:
    # as a power of it, nearly.
    few, more = (
        {body: sphere_fit.fit_body(own, num, rng)[2] for body, own in samples.items()}
        for num in _PROBES
    )
    growth = np.log(_PROBES[1] / _PROBES[0])
    power = {
        body: max(np.log((few[body] + 1e-9) / (more[body] + 1e-9)) / growth, 0.1) for body in few
    }

    def volume(body: int, count: int) -> float:
        return few[body] * (count / _PROBES[0]) ** -power[body]

    used = dict.fromkeys(samples, 1)
    while sum(used.values()) < num_spheres:
        saved = {
            body: volume(body, count) - volume(body, count + 1)
            for body, count in used.items()
            if count < sphere_fit.MAX_SPHERES
        }
        if not saved:
            break
        used[max(saved, key=lambda body: saved[body])] += 1
    fitted = {}
    for body, count in used.items():
        fitted[body] = sphere_fit.fit_body(samples[body], count, rng, moves=_MOVES)[:2]
        progress(f"body {body}: {count} spheres")
    return fitted
