"""Small maps and data sets, and what several test files compute in plain numpy."""

import heapq

import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.robots import load_robot
from nrp_jax.scene.world import batch_is_free, build_world


def random_grid(seed: int, size: int = 60, height: int = 1, boxes: int = 14):
    """A map with boxes in it and walls around it."""
    rng = np.random.default_rng(seed)
    occupied = np.zeros((size, size, height), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    for _ in range(boxes):
        low = rng.integers(0, size, 2)
        high = low + rng.integers(3, 10, 2)
        occupied[low[0] : high[0], low[1] : high[1], : rng.integers(1, height + 1)] = True
    return Grid(occupied=occupied)


def two_rooms():
    """Two rooms and a door of one meter."""
    occupied = np.zeros((50, 40), bool)
    occupied[24:26] = True
    occupied[24:26, 25:35] = False
    return Grid(occupied=occupied)


def free(world, q: np.ndarray) -> np.ndarray:
    """Which configurations (n, D) are free, in blocks of one size: one program for all."""
    block = 2048
    padded = np.resize(q, (-(-len(q) // block) * block, q.shape[1])).astype(np.float32)
    parts = [batch_is_free(world, part) for part in padded.reshape(-1, block, q.shape[1])]
    return np.concatenate(parts)[: len(q)]


def synthetic_rows(homes: int = 4, queries: int = 24, waypoints: int = 6, seed: int = 0):
    """Grids and rows of the snake; ``good`` tells whether the straight edge is free.

    So there is a rule to learn: can the robot go straight to the waypoint?
    """
    robot = load_robot("snake")
    grids = [random_grid(seed + k) for k in range(homes)]
    rows = {name: [] for name in ("q_start", "q_goal", "waypoint", "home", "query", "good")}
    for home, grid in enumerate(grids):
        rng = np.random.default_rng(seed + home)
        world = build_world(robot, grid)
        lower, upper = np.asarray(world.lower), np.asarray(world.upper)
        q = rng.uniform(lower, upper, (4096, 8)).astype(np.float32)
        q = q[free(world, q)][: 2 * queries]
        assert len(q) == 2 * queries
        start = np.repeat(q[:queries], waypoints, axis=0)
        waypoint = rng.uniform(lower, upper, start.shape).astype(np.float32)
        waypoint[:, :2] = start[:, :2] + rng.uniform(-1.5, 1.5, (len(start), 2))
        fraction = np.linspace(0, 1, 20)[:, None, None]
        edge = start + fraction * (waypoint - start)
        good = free(world, edge.reshape(-1, 8)).reshape(20, -1).all(axis=0)
        rows["q_start"].append(start)
        rows["q_goal"].append(np.repeat(q[queries:], waypoints, axis=0))
        rows["waypoint"].append(waypoint)
        rows["home"].append(np.full(len(start), home))
        rows["query"].append(np.repeat(np.arange(queries), waypoints))
        rows["good"].append(good)
    return robot, grids, {name: np.concatenate(parts) for name, parts in rows.items()}


def between(world, a, b, fractions):
    """Configurations (n, D) on the straight edge from a to b."""
    step = b - a
    turns = np.where(np.asarray(world.is_continuous), np.round(step / (2 * np.pi)), 0)
    return a + np.asarray(fractions)[:, None] * (step - 2 * np.pi * turns)


def path_lengths(roadmap, goal):
    """Length of the shortest path (N,) from every node to a goal, by a plain Dijkstra."""
    lengths = np.full(len(roadmap.q), np.inf)
    lengths[goal] = 0
    queue = [(0.0, goal)]
    while queue:
        length, node = heapq.heappop(queue)
        if length > lengths[node]:
            continue
        row = slice(*roadmap.lengths.indptr[node : node + 2])
        for other, edge in zip(
            roadmap.lengths.indices[row], roadmap.lengths.data[row], strict=True
        ):
            if length + edge < lengths[other]:
                lengths[other] = length + edge
                heapq.heappush(queue, (length + edge, other))
    return lengths
