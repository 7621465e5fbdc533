"""The narrow phase: where spheres touch, planes between polytopes tell whether the bodies do.

Spheres that cover a body stick out of it by a centimeter or two. Where they touch something, but
not so deeply that the body certainly does, :mod:`vrrt_jax.scene.body_polytopes` looks for a plane
between the two. Where it finds none, what the spheres say stands.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import lever_arms, place
from vrrt_jax.scene.body_polytopes import BodyPolytopes, body_polytopes, bulges
from vrrt_jax.scene.obstacles import signed_distances
from vrrt_jax.scene.rows import least, over_rows

# Self-collision spheres are no cover: they miss touches of up to 24 mm, in 0.1 % of configurations.
# Nearer than this they count as touching where polytopes look again [m], but between bodies with
# few joints between them: these are always near, and the spheres were fitted to just that.
SLACK = 0.01
_FEW_JOINTS = 2


@pytree
class NarrowPhase:
    """The bodies that the spheres of a robot stand for; without polytopes one has the index P.

    Letters as in :class:`vrrt_jax.scene.spheres.WorldSpheres`.
    """

    polytopes: BodyPolytopes  # of P bodies
    body: jax.Array  # (n,) i32 that each collision sphere covers
    # How far points of a body move at most while one joint moves by one; 0 if it carries it not.
    lever_arms: jax.Array  # (D, P) [m/rad] or [m/m]
    bulge: jax.Array  # (n,) what is deeper in a sphere touches the polytope [m]
    pair_bulge: jax.Array  # (a, b) likewise of two self-collision spheres [m]
    slack: jax.Array  # (a, b) what is in the contact distances for a second look [m]
    first_body: jax.Array  # (a,) i32 of self-collision spheres, rows of the contact distances
    second_body: jax.Array  # (b,) i32 columns likewise

    def is_in_doubt(self, clearance: jax.Array, gaps: jax.Array) -> jax.Array:
        """Whether () bool no sphere is so deep in something that its body certainly touches it.

        Args:
            clearance: (n,) of collision spheres to obstacles [m].
            gaps: (a, b) between self-collision spheres [m].
        """
        deepest = jnp.min(gaps + self.pair_bulge, initial=jnp.inf)
        return (jnp.min(clearance + self.bulge) >= 0) & (deepest >= 0)


@over_rows
def look_again(common: Any, rows: Any) -> tuple[jax.Array, jax.Array]:
    """What polytopes say of n configurations, of which only those in doubt are looked at.

    Args:
        common: the spheres, obstacles, and the margin () [m].
        rows: poses (n, L, 4, 4) of links; edges (n, D); what spheres say: shares (n,) of the edges
            that are free, distances (n,) to obstacles [m]; and which (n,) bool are in doubt.

    Returns:
        The shares (n,) and the distances (n,).
    """
    spheres, obstacles, margin = common
    poses, edge, *start = rows
    if not len(edge):
        return start[0], start[1]

    # One after another: each takes as long as it needs, which no batch could.
    def look(state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        span, nearest, in_doubt = state
        at = jnp.argmax(in_doubt)
        found = _look(spheres, obstacles, margin, poses[at], edge[at])
        return (
            span.at[at].set(found[0]),
            nearest.at[at].set(found[1]),
            in_doubt.at[at].set(False),
        )

    span, nearest, _ = jax.lax.while_loop(lambda state: jnp.any(state[2]), look, tuple(start))
    return span, nearest


def _look(
    spheres: Any, obstacles: Any, margin: jax.Array, poses: jax.Array, edge: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """:func:`look_again` at one configuration: () and () [m]."""
    phase = spheres.narrow_phase
    outer, inner = place(spheres.collision, poses), place(spheres.self_collision, poses)
    columns = inner[:, inner.shape[1] - spheres.contact_distance.shape[1] :]

    def at_obstacle(state: "_State") -> "_State":
        slot, sphere = state.apart.place
        body = phase.body[sphere]
        gap = phase.polytopes.obstacle_gap(body, outer[:, sphere], poses, obstacles, slot) - margin
        is_pair = (jnp.arange(len(obstacles.rounding)) == slot)[:, None] & (phase.body == body)
        speed = jnp.abs(edge) @ phase.lever_arms[:, body]
        return _State(
            apart=state.apart.at_least(gap, is_pair),
            gaps=state.gaps,
            span=jnp.minimum(state.span, gap / (speed + 1e-9)),
            is_apart=gap > 0,
        )

    def at_bodies(state: "_State") -> "_State":
        row, column = state.gaps.place
        first, second = phase.first_body[row], phase.second_body[column]
        points = inner[:, row], columns[:, column]
        gap = phase.polytopes.body_gap(first, second, points, poses) - spheres.self_margin
        is_pair = (phase.first_body == first)[:, None] & (phase.second_body == second)
        # Joints that carry both bodies leave their distance as it is.
        one, other = phase.lever_arms[:, first], phase.lever_arms[:, second]
        speed = jnp.abs(edge) @ jnp.where((one > 0) != (other > 0), one + other, 0.0)
        return _State(
            apart=state.apart,
            gaps=state.gaps.at_least(gap, is_pair),
            span=jnp.minimum(state.span, gap / (speed + 1e-9)),
            is_apart=gap >= 0,
        )

    def is_open(state: "_State") -> jax.Array:
        return state.is_apart & ((state.apart.least <= 0) | (state.gaps.least < 0))

    def look(state: "_State") -> "_State":
        if not spheres.contact_distance.size:  # no two bodies are checked
            return at_obstacle(state)
        return jax.lax.cond(state.apart.least <= 0, at_obstacle, at_bodies, state)

    # The deepest pair first, until one cannot be told apart.
    start = _State(
        apart=_nearest(signed_distances(obstacles, outer) - spheres.needed(margin)),
        gaps=_nearest(spheres.gaps(inner)),
        span=jnp.float32(jnp.inf),
        is_apart=jnp.array(True),
    )
    found = jax.lax.while_loop(is_open, look, start)
    span = jax.lax.cond(
        found.is_apart,
        lambda: spheres.free_span(least(found.apart.distances), found.gaps.distances, edge),
        lambda: jnp.float32(-1.0),
    )
    return jnp.minimum(span, found.span), found.apart.least


@pytree
class _Nearest:
    """Distances between two kinds of things, and the least of them."""

    distances: jax.Array  # (r, c) [m]
    least: jax.Array  # () [m]
    place: tuple[jax.Array, jax.Array]  # () i32 row and column of the least

    def at_least(self, gap: jax.Array, where: jax.Array) -> "_Nearest":
        """The same distances, of which some (r, c) are known to be at least a gap () [m]."""
        return _nearest(jnp.where(where, jnp.maximum(self.distances, gap), self.distances))


def _nearest(distances: jax.Array) -> _Nearest:
    """The least of distances (r, c) [m]; infinite if there are none."""
    if not distances.size:
        none = jnp.int32(0)
        return _Nearest(distances=distances, least=jnp.float32(jnp.inf), place=(none, none))
    # Row by row: XLA's CPU backend vectorizes a minimum, but not the search for its place.
    row = jnp.argmin(jnp.min(distances, axis=1)).astype(jnp.int32)
    place = row, jnp.argmin(distances[row]).astype(jnp.int32)
    return _Nearest(distances=distances, least=distances[place], place=place)


@pytree
class _State:
    """What is known of a configuration so far."""

    apart: _Nearest  # (K, n) of obstacles and collision spheres
    gaps: _Nearest  # (a, b) of self-collision spheres
    span: jax.Array  # () share of the edge that bodies that were looked at are free along
    is_apart: jax.Array  # () bool, whether all of these are


def narrow_phase(
    robot: Any, num: int, num_self: int, num_rows: int, begin: int
) -> NarrowPhase | None:
    """What the narrow phase needs to know of a robot.

    Args:
        robot: with or without polytopes.
        num: n, with held ones.
        num_self: m, with held ones.
        num_rows: a.
        begin: of the m the first of the b.
    """
    if not robot.polytopes:
        return None
    polytopes, names = body_polytopes(robot.polytopes)
    index = {name: k for k, name in enumerate(names)}

    def bodies(of_spheres: Sequence[str], size: int) -> np.ndarray:
        found = [index.get(name, len(names)) for name in of_spheres]
        return np.array(found + [len(names)] * (size - len(found)), np.int32)

    spheres, others = robot.collision_spheres, robot.self_collision_sphere_bodies
    bulge, self_bulge = np.zeros(num), np.zeros(num_self)  # what is held is no polytope
    bulge[: len(spheres.radius)] = bulges(robot.polytopes, robot.collision_sphere_bodies, spheres)
    self_bulge[: len(others)] = bulges(robot.polytopes, others, robot.self_collision_spheres)
    pairs = self_bulge[:num_rows, None] + self_bulge[begin:]
    first, second = bodies(others, num_self)[:num_rows], bodies(others, num_self)[begin:]
    links = np.asarray(polytopes.link)
    carriers = _carriers(robot.chain.parents)[links]
    # Bodies without polytopes, the last row and column, need none.
    many = np.pad((carriers[:, None] != carriers).sum(axis=-1) > _FEW_JOINTS, (0, 1))
    slack = np.where(many[first[:, None], second], SLACK, 0.0)
    return NarrowPhase(
        polytopes=polytopes,
        lever_arms=jnp.asarray(_lever_arms(robot, names) * carriers.T, jnp.float32),
        body=jnp.asarray(bodies(robot.collision_sphere_bodies, num)),
        bulge=jnp.asarray(bulge, jnp.float32),
        pair_bulge=jnp.asarray(pairs + slack, jnp.float32),
        slack=jnp.asarray(slack, jnp.float32),
        first_body=jnp.asarray(first),
        second_body=jnp.asarray(second),
    )


def _carriers(parents: Sequence[int]) -> np.ndarray:
    """Which of D joints carry each of the L links, (L, D) bool."""
    carriers = np.zeros((len(parents) + 1, len(parents)), bool)
    for joint, parent in enumerate(parents):  # parents come before their children
        carriers[joint + 1] = carriers[parent]
        carriers[joint + 1, joint] = True
    return carriers


def _lever_arms(robot: Any, names: Sequence[str]) -> np.ndarray:
    """How far points of bodies move at most while one joint moves by one, (D, P)."""
    arms = np.zeros((robot.num_joints, len(names)))
    for polytope in robot.polytopes:
        middle = polytope.vertices.mean(axis=0)
        radius = np.linalg.norm(polytope.vertices - middle, axis=1).max()
        link = np.array([polytope.link])
        own = lever_arms(robot.chain, link, middle[None], robot.lower, robot.upper)[:, 0]
        own += radius * robot.chain.is_hinge
        body = names.index(polytope.body)
        arms[:, body] = np.maximum(arms[:, body], own)
    return arms
