"""A robot in a home: is this configuration free, how far is it to that one, and on which way."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene import reeds_shepp
from nrp_jax.scene.field import DistanceField, clearance_bound, make_field
from nrp_jax.scene.robots import MobileRobot, PlanarBoxes
from vrrt_jax.core.edges import StraightLineEdges, joint_steps
from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import Chain, Spheres, link_poses, place, placement

ARM_WEIGHT = {"snake": 0.167, "fetch": 0.125}  # of the paper's metrics
RESOLUTION = {"snake": 0.1, "fetch": 0.2}  # sub-steps of the paper [m] and [rad]
TURNING_RADIUS = 0.1  # of the Fetch's base [m]
SHORTLIST = 16  # nodes for which the length of a curve is computed


@pytree
class RoundBase:
    """A round base among the cells that are low enough to be in its way."""

    field: DistanceField  # planar
    radius: jax.Array  # () [m]
    height: jax.Array  # () [m]
    link: int = static()


@pytree
class GridWorld(StraightLineEdges):
    """What planners ask about a robot on a sliding base in a home; edges are straight.

    An edge's length is that of the base's way plus ``arm_weight`` times that of the arm's; its
    sub-steps move no joint by more than ``resolution``.
    """

    chain: Chain
    collision_spheres: jax.Array  # (L * 12, 3 n) placement of the covering spheres
    collision_radius: jax.Array  # (n,) [m]
    floor: jax.Array  # (n,) lowest height of their centers, -inf if they may touch the floor [m]
    plates: PlanarBoxes | None  # checked against each other instead
    contact_distance: (
        jax.Array
    )  # (m, n) at which the last m touch others, 0 for pairs not checked [m]
    base: RoundBase | None
    field: DistanceField
    lower: jax.Array  # (D,)
    upper: jax.Array  # (D,)
    is_continuous: jax.Array  # (D,) bool
    arm_weight: jax.Array  # () meters a radian of the arm counts for
    resolution: jax.Array  # () longest sub-step of any joint [m] or [rad]

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`is_free`."""
        return is_free(self, q)

    def interpolate(self, q_a: jax.Array, q_b: jax.Array, fraction: jax.Array) -> jax.Array:
        """Configurations (..., D) at a fraction (...) of the edges between others (..., D)."""
        part = self.truncate(self.edge(q_a, q_b), jnp.asarray(fraction, q_a.dtype))
        return self.normalize(self.end(q_a, part))

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        base, arm = jnp.zeros((2, q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            squared = joint_steps(self, nodes, q, joint) ** 2
            base, arm = (base + squared, arm) if joint < 2 else (base, arm + squared)
        return jnp.where(among, jnp.sqrt(base) + self.arm_weight * jnp.sqrt(arm), jnp.inf)

    def length(self, edge: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return _norm(edge[..., :2]) + self.arm_weight * _norm(edge[..., 2:])

    def span(self, edge: jax.Array) -> jax.Array:
        """The longest way (...) of any joint along an edge [m] or [rad]."""
        return jnp.max(jnp.abs(edge), axis=-1)

    def steer(self, q_from: jax.Array, target: jax.Array, num_steps: int) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        inside = jnp.where(self.is_continuous, target, jnp.clip(target, self.lower, self.upper))
        edge = self.edge(q_from, inside)
        longest = num_steps * self.resolution
        return self.truncate(edge, jnp.minimum(1.0, longest / jnp.maximum(self.span(edge), 1e-9)))

    def is_resolved(self, edge: jax.Array, num_steps: int | jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return self.span(edge) <= num_steps * self.resolution * (1 + 1e-5)

    def parts(self, edge: Any, most: int) -> jax.Array:
        """Fewest parts (...) of an edge that are resolved each; ``most + 1`` if it takes more."""
        enough = jax.vmap(self.is_resolved, (None, 0))(edge, jnp.arange(1, most + 1))
        return 1 + jnp.sum(~enough, axis=0)


@pytree
class CarEdge:
    """A drive of the base, while the arm goes straight."""

    curve: reeds_shepp.Curve
    arm: jax.Array  # (..., D - 3) step
    target: jax.Array  # (..., D) where the whole edge leads
    done: jax.Array  # (...) 1 while nothing has been cut off


@pytree
class CarWorld(GridWorld):
    """The same with a base that turns and drives like a car, forwards and in reverse."""

    radius: jax.Array  # () smallest turning radius [m]

    def distance(self, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        drive = reeds_shepp.length(q_a[..., :3], q_b[..., :3], self.radius)
        arm = StraightLineEdges.edge(self, q_a, q_b)[..., 3:]
        return drive + self.arm_weight * _norm(arm)

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`; +inf beyond a shortlist of nearest nodes.

        The shortlist goes by a bound: no drive is shorter than the straight line, nor than its turn
        at the smallest radius. The nearest is nearly always in it.
        """
        line, arm = jnp.zeros((2, q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            step = joint_steps(self, nodes, q, joint)
            if joint == 2:
                turn = self.radius * jnp.abs(step)
                continue
            line, arm = (line + step**2, arm) if joint < 2 else (line, arm + step**2)
        bound = jnp.maximum(jnp.sqrt(line), turn) + self.arm_weight * jnp.sqrt(arm)
        bound = jnp.where(among, bound, jnp.inf)
        nearest, index = _shortlist(bound)
        exact = self.distance(q[:, None], nodes[index])
        exact = jnp.where(jnp.isfinite(nearest), exact, jnp.inf)
        row = jnp.arange(q.shape[0])[:, None]
        return jnp.full(bound.shape, jnp.inf, q.dtype).at[row, index].set(exact)

    def edge(self, q_from: jax.Array, q_to: jax.Array) -> CarEdge:
        """See :class:`vrrt_jax.core.edges.Space`."""
        step = StraightLineEdges.edge(self, q_from, q_to)
        return CarEdge(
            curve=reeds_shepp.shortest(q_from[..., :3], q_to[..., :3], self.radius),
            arm=step[..., 3:],
            target=jnp.broadcast_to(q_to, step.shape),
            done=jnp.ones(step.shape[:-1], step.dtype),
        )

    def truncate(self, edge: CarEdge, fraction: jax.Array) -> CarEdge:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return CarEdge(
            curve=reeds_shepp.cut(edge.curve, fraction, self.radius),
            arm=edge.arm * fraction[..., None],
            target=edge.target,
            done=edge.done * fraction,
        )

    def length(self, edge: CarEdge) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return self._drive(edge) + self.arm_weight * _norm(edge.arm)

    def span(self, edge: CarEdge) -> jax.Array:
        """The longest way (...) of base, with what it turns, or any joint [m] or [rad]."""
        base = reeds_shepp.extent(edge.curve, self.radius)
        return jnp.maximum(base, jnp.max(jnp.abs(edge.arm), axis=-1))

    def end(self, q_from: jax.Array, edge: CarEdge) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`; the whole edge ends at its target exactly."""
        base = reeds_shepp.follow(q_from[..., :3], edge.curve, self.radius)
        q = jnp.concatenate([base, q_from[..., 3:] + edge.arm], axis=-1)
        return jnp.where((edge.done >= 1)[..., None], edge.target, q)

    def _drive(self, edge: CarEdge) -> jax.Array:
        return reeds_shepp.curve_length(edge.curve) * self.radius


def is_free(world: GridWorld, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) touches no solid cell, not the floor, nor itself, () bool.

    Joint limits are not looked at; beside the map all is solid. Pure and vmappable.
    """
    poses = link_poses(world.chain, q)
    # The barrier keeps XLA's CPU fusions from placing the spheres once for every use.
    centers = jax.lax.optimization_barrier(place(world.collision_spheres, poses))
    first = world.contact_distance.shape[1] - world.contact_distance.shape[0]
    apart = sum((axis[first:, None] - axis) ** 2 for axis in centers)
    free = jnp.all(apart >= world.contact_distance**2)
    free &= jnp.all(clearance_bound(world.field, centers) > world.collision_radius)
    free &= jnp.all(centers[2] > world.floor)
    if world.plates is not None:
        free &= _plates_apart(world.plates, poses)
    if world.base is not None:
        free &= _base_is_free(world.base, poses, centers, world.collision_radius, world.floor)
    return free


batch_is_free = jax.jit(jax.vmap(is_free, (None, 0)))  # of q (n, D), for the host


def _plates_apart(plates: PlanarBoxes, poses: jax.Array) -> jax.Array:
    """Whether no two of the checked plates overlap: some side separates them."""
    pose = poses[jnp.array(plates.link)]
    cosine, sine = pose[:, 0, 0], pose[:, 1, 0]
    center = jnp.einsum("mij,mj->mi", pose[:, :2, :2], plates.center) + pose[:, :2, 3]
    pairs = jnp.array(plates.pairs).T
    (c_i, c_j), (s_i, s_j), (half_i, half_j) = cosine[pairs], sine[pairs], plates.half[pairs]
    turned = jnp.abs(jnp.stack([c_i * c_j + s_i * s_j, c_i * s_j - s_i * c_j]))
    dx, dy = (center[pairs[1]] - center[pairs[0]]).T
    apart = jnp.zeros(len(plates.pairs), bool)
    for (c, s), own, other in (((c_i, s_i), half_i, half_j), ((c_j, s_j), half_j, half_i)):
        ahead, beside = jnp.abs(c * dx + s * dy), jnp.abs(c * dy - s * dx)
        apart |= ahead > own[:, 0] + other[:, 0] * turned[0] + other[:, 1] * turned[1]
        apart |= beside > own[:, 1] + other[:, 0] * turned[1] + other[:, 1] * turned[0]
    return jnp.all(apart)


def _base_is_free(
    base: RoundBase, poses: jax.Array, centers: jax.Array, radius: jax.Array, floor: jax.Array
) -> jax.Array:
    """Whether a cylinder touches neither a cell nor the spheres that must not touch the floor."""
    position = poses[base.link, :3, 3:]
    beside = jnp.sqrt(jnp.sum((centers[:2] - position[:2]) ** 2, axis=0)) - base.radius
    above = centers[2] - base.height
    gap = jnp.maximum(beside, 0.0) ** 2 + jnp.maximum(above, 0.0) ** 2
    return (clearance_bound(base.field, position)[0] > base.radius) & jnp.all(
        (gap > radius**2) | jnp.isinf(floor)
    )


def build_world(
    robot: MobileRobot,
    grid: Grid,
    *,
    wrap: bool = True,
    resolution: float | None = None,
    arm_weight: float | None = None,
    turning_radius: float = TURNING_RADIUS,
) -> GridWorld:
    """Put a robot into a home.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: from :func:`nrp_jax.load_map` or a generator; the snake sees its planar map.
        wrap: joints without limits turn the short way round; otherwise they are intervals, as in
            the paper. A heading always wraps.
        resolution: longest sub-step of any joint between two collision checks [m] or [rad]; the
            paper's by default.
        arm_weight: meters that a radian of the arm counts for in the metric; the paper's by
            default.
        turning_radius: smallest one of a base that drives like a car [m].

    Raises:
        ValueError: a planar map for a robot that is not, or a setting that is not positive.
    """
    resolution = RESOLUTION[robot.name] if resolution is None else resolution
    arm_weight = ARM_WEIGHT[robot.name] if arm_weight is None else arm_weight
    for name, value in (
        ("resolution", resolution),
        ("arm_weight", arm_weight),
        ("turning_radius", turning_radius),
    ):
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive number, such as 0.1")
    grid = _fitting(robot.planar, grid)
    is_arm = np.asarray(robot.collision_spheres.link) > robot.base_dim + 1
    floor = np.where(is_arm & (not robot.planar), robot.collision_spheres.radius, -np.inf)
    turn = [np.pi] * (robot.base_dim - 2)
    is_base = np.arange(robot.num_joints) < robot.base_dim
    corner = np.array(grid.origin[:2])
    fields = {
        "chain": robot.chain,
        "collision_spheres": _placement(robot.collision_spheres, robot.chain),
        "collision_radius": robot.collision_spheres.radius,
        "floor": jnp.asarray(floor, jnp.float32),
        "plates": robot.plates,
        "contact_distance": jnp.asarray(_reach(robot)),
        "base": _round_base(robot, grid),
        "field": make_field(grid),
        "lower": _float(np.concatenate([corner, np.negative(turn), robot.lower])),
        "upper": _float(np.concatenate([corner + grid.size[:2], turn, robot.upper])),
        "is_continuous": robot.is_continuous & (is_base | wrap),
        "arm_weight": jnp.float32(arm_weight),
        "resolution": jnp.float32(resolution),
    }
    if robot.base_dim == 2:
        return GridWorld(**fields)
    return CarWorld(**fields, radius=jnp.float32(turning_radius))


def with_grid(world: GridWorld, grid: Grid) -> GridWorld:
    """The same robot in another home; nothing re-compiles if the maps are of one size.

    Raises:
        ValueError: a planar map for a robot that is not.
    """
    grid = _fitting(world.field.values.shape[2] == 1, grid)
    corner = np.array(grid.origin[:2])
    base = world.base
    if base is not None:
        base = dataclasses.replace(base, field=_low_field(grid, float(base.height)))
    return dataclasses.replace(
        world,
        base=base,
        field=make_field(grid),
        lower=world.lower.at[:2].set(corner),
        upper=world.upper.at[:2].set(corner + grid.size[:2]),
    )


def _norm(step: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(step**2, axis=-1))


def _shortlist(bound: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Smallest bounds (B, k) of (B, N) and where they are."""
    smallest, index = jax.lax.top_k(-bound, min(SHORTLIST, bound.shape[1]))
    return -smallest, index


def _fitting(planar: bool, grid: Grid) -> Grid:
    if planar:
        return grid.flatten()
    if grid.planar:
        raise ValueError(
            "this robot needs a map with heights, but this one is planar: shape "
            f"{grid.occupied.shape}; load a 3D map, or plan for the snake"
        )
    return grid


def _reach(robot: MobileRobot) -> np.ndarray:
    """Sums of the radii (m, n) of pairs of the last m of n spheres with any; 0 if not checked."""
    radius, (first, second) = (
        np.asarray(robot.collision_spheres.radius),
        np.asarray(robot.self_collision_pairs).T,
    )
    if not len(first):
        return np.zeros((0, len(radius)), np.float32)
    reach = np.zeros((len(radius),) * 2, np.float32)
    reach[second, first] = radius[first] + radius[second]
    return reach[second.min() :]


def _round_base(robot: MobileRobot, grid: Grid) -> RoundBase | None:
    footprint = robot.footprint
    if footprint is None:
        return None
    return RoundBase(
        field=_low_field(grid, float(footprint.height)),
        radius=footprint.radius,
        height=footprint.height,
        link=footprint.link,
    )


def _low_field(grid: Grid, height: float) -> DistanceField:
    return make_field(grid.flatten(0.0, height))


def _placement(spheres: Spheres, chain: Chain) -> jax.Array:
    matrix = placement(np.asarray(spheres.link), np.asarray(spheres.center), chain.num_links)
    return _float(matrix)


def _float(array: np.ndarray) -> jax.Array:
    return jnp.asarray(array, jnp.float32)
