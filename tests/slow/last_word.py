"""The last word: what is called free, judged again by a plain and dense walk in C MuJoCo.

Run ``python -m tests.slow.last_word --paths 1000``. Most paths are near-misses: a straight path is
shifted until the exact check changes its mind, and both sides of that are paths. Configurations are
near-misses too: half of them lie where the covers change their mind.
"""

import argparse
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import nrp_jax
import vrrt_jax
from nrp_jax.homes.houses import generate_house
from nrp_jax.problems import load_problem as load_home
from nrp_jax.scene.exact import STEP, ExactScene, verify
from nrp_jax.scene.trajectory import trajectory_of
from nrp_jax.scene.world import batch_is_free
from vrrt_jax.bench.worlds import random_world
from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots.robot import workspace
from vrrt_jax.scene.advance import FINEST
from vrrt_jax.scene.verify import contacts

from .plain import NEAR, PlainScene, plain_arm, plain_home

STATED = FINEST / 2  # [m] no deeper contact is missed
ARM_STEP = 0.005  # [rad] of verify_path
HALVINGS = 10
BLOCK = 1024


@dataclasses.dataclass(kw_only=True)
class Place:
    """A robot somewhere, with both judges, and what the planner's covers say."""

    name: str
    plain: PlainScene
    lower: np.ndarray
    upper: np.ndarray
    step: float  # of the dense walk, a tenth of the exact check's
    exact: Callable[[np.ndarray], bool]  # whether a path (P, D) is called free
    covers: dict[str, Callable[[np.ndarray], np.ndarray]]  # of q (n, D), by engine
    straight: Callable[[np.ndarray, np.ndarray], np.ndarray]  # a path between two ends
    shifts: np.ndarray  # (D,) by how much a path is shifted at most
    plan: Callable[[np.ndarray, np.ndarray, int], np.ndarray | None]
    reach: float  # length of straight paths, as a share of the limits


def small_things(robot: Any, rng: np.random.Generator) -> list[vrrt_jax.Obstacle]:
    """Sheets of 1 mm and balls of 5 mm within reach, none of which touches the robot at home."""
    center, radius = workspace(robot)
    found: list[vrrt_jax.Obstacle] = []
    while len(found) < 40:
        direction = rng.normal(size=3)
        place = center + radius * rng.uniform(0.3, 0.9) * direction / np.linalg.norm(direction)
        turn, is_ball = rng.normal(size=4), len(found) % 2
        obstacle = vrrt_jax.Obstacle(
            name=f"small {len(found)}",
            kind="sphere" if is_ball else "box",
            position=tuple(place),
            quaternion=tuple(turn / np.linalg.norm(turn)),
            size=(0.005, 0, 0) if is_ball else (0.0005, *rng.uniform(0.03, 0.15, 2)),
        )
        if not contacts(robot, [*found, obstacle], robot.home):
            found.append(obstacle)
    return found


def arm_place(name: str, obstacles: list[vrrt_jax.Obstacle], engines=("closed_form", "mjx")):
    """An arm among obstacles."""
    robot = vrrt_jax.load_robot(name)
    worlds = {e: vrrt_jax.build_world(robot, obstacles, engine=e) for e in engines}
    first = next(iter(worlds.values()))

    def plan(start, goal, seed):
        key = jax.random.key(seed)
        return vrrt_jax.plan_to_configuration(robot, first, start, goal, key=key).path

    return Place(
        name=name,
        plain=plain_arm(robot, obstacles),
        lower=np.asarray(robot.lower).clip(-np.pi),
        upper=np.asarray(robot.upper).clip(max=np.pi),
        step=ARM_STEP / 10,
        exact=lambda path: vrrt_jax.verify_path(robot, obstacles, path, step=ARM_STEP).ok,
        covers={e: functools.partial(in_blocks, _arm_is_free, w) for e, w in worlds.items()},
        straight=lambda a, b: np.stack([a, b]),
        shifts=0.15 * np.minimum(robot.upper - robot.lower, np.pi),
        plan=plan,
        reach=0.12,
    )


def home_place(name: str, grid: nrp_jax.Grid):
    """A mobile robot in a home."""
    robot = nrp_jax.load_robot(name)
    world, scene = nrp_jax.build_world(robot, grid), ExactScene(robot, grid)
    lower, upper = np.asarray(world.lower), np.asarray(world.upper)

    def plan(start, goal, seed):
        key = jax.random.key(seed)
        return nrp_jax.plan(
            robot, grid, start, goal, key=key, world=world, scene=scene, max_expansions=6400
        ).trajectory

    shifts = np.zeros(robot.num_joints)
    shifts[:2] = 0.5
    return Place(
        name=name,
        plain=plain_home(robot, grid),
        lower=lower.clip(-np.pi if name == "fetch" else -1e9),
        upper=upper,
        step=STEP / 10,
        exact=lambda path: verify(scene, path, lower=lower, upper=upper).ok,
        covers={"cells": functools.partial(in_blocks, batch_is_free, world)},
        straight=lambda a, b: trajectory_of(world, np.stack([a, b]).astype(np.float32)),
        shifts=shifts,
        plan=plan,
        reach=0.1,
    )


_arm_is_free = single_precision(jax.jit(jax.vmap(vrrt_jax.is_free, (None, 0))))


def in_blocks(is_free: Callable, world: Any, q: np.ndarray) -> np.ndarray:
    """Which configurations (n, D) are free, in blocks of one size."""
    padded = np.resize(q, (-(-len(q) // BLOCK) * BLOCK, q.shape[1])).astype(np.float32)
    parts = [is_free(world, part) for part in padded.reshape(-1, BLOCK, q.shape[1])]
    return np.concatenate(parts)[: len(q)]


def free_configurations(place: Place, num: int, rng: np.random.Generator) -> np.ndarray:
    """(num, D) that the covers call free."""
    found = np.zeros((0, len(place.lower)))
    cover = next(iter(place.covers.values()))
    while len(found) < num:
        q = rng.uniform(place.lower, place.upper, (BLOCK, len(place.lower)))
        found = np.concatenate([found, q[cover(q)]])
    return found[:num]


def near_misses(place: Place, num: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Paths on both sides of where the exact check changes its mind, and some planned ones."""
    ends = free_configurations(place, num + 1, rng)
    made = 0
    for index, start in enumerate(ends):
        if index % 20 == 0:
            path = place.plan(start, ends[-1 - index], index)
            if path is not None:
                yield np.asarray(path, np.float64)
                made += 1
        turn = rng.normal(size=len(start)) * place.reach * (place.upper - place.lower)
        goal = np.clip(start + turn, place.lower, place.upper)
        path = np.asarray(place.straight(start, goal), np.float64)
        shift = rng.uniform(-1, 1, len(start)) * place.shifts
        verdicts = [place.exact(path), place.exact(path + shift)]
        low, high = 0.0, 1.0
        yield path
        yield path + shift
        made += 2
        if verdicts[0] != verdicts[1]:
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                yield path + middle * shift
                made += 1
                same = place.exact(path + middle * shift) == verdicts[0]
                low, high = (middle, high) if same else (low, middle)
        if made >= num:
            return


def judge_paths(place: Place, num: int, seed: int) -> dict[str, Any]:
    """Counts of paths; ``missed`` are called free and are deeper than what is stated."""
    rng = np.random.default_rng(seed)
    count = dict.fromkeys(("paths", "free", "near", "touching", "missed", "refused_untouched"), 0)
    deepest, examples = -NEAR, []
    for path in near_misses(place, num, rng):
        count["paths"] += 1
        is_free = place.exact(path)
        # Of those that are refused, some are looked at: is there anything to refuse?
        if not is_free:
            if count["paths"] % 10 == 0 and place.plain.depth(path, place.step) < -1e-5:
                inside = (path >= place.lower - 1e-5) & (path <= place.upper + 1e-5)
                count["refused_untouched"] += bool(inside.all())
            continue
        depth = place.plain.depth(path, place.step)
        count["free"] += 1
        count["near"] += int(depth > -NEAR)
        count["touching"] += int(depth > 0)
        deepest = max(deepest, float(depth))
        if depth > STATED:
            count["missed"] += 1
            examples.append(path.tolist())
    return {**count, "deepest_mm": round(1e3 * deepest, 4), "examples": examples[:3]}


def near_configurations(place: Place, num: int, rng: np.random.Generator) -> np.ndarray:
    """(num, D) anywhere, and as many again where the covers change their mind."""
    shape = (num, len(place.lower))
    q = rng.uniform(place.lower, place.upper, shape)
    cover = next(iter(place.covers.values()))
    free = free_configurations(place, num, rng)
    other = np.clip(free + 0.3 * rng.normal(size=shape), place.lower, place.upper)
    bad, low, high = ~cover(other), np.zeros(num), np.ones(num)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        is_free = cover(free + middle[:, None] * (other - free))
        low, high = np.where(is_free, middle, low), np.where(is_free, high, middle)
    low = np.where(bad, low, rng.uniform(size=num))
    return np.concatenate([q, free + low[:, None] * (other - free)]).astype(np.float32)


def judge_configurations(place: Place, num: int, seed: int) -> dict[str, Any]:
    """Counts of configurations that a judge calls free and C MuJoCo does not.

    Judges are the covers, which should miss nothing of the world, and the exact check, which may
    miss what is stated.
    """
    q = near_configurations(place, num // 2, np.random.default_rng(seed))
    to_world, to_itself = place.plain.distances(q)
    found: dict[str, Any] = {"configurations": len(q), "colliding": int((to_world < 0).sum())}
    judges = {**place.covers, "exact": lambda q: np.array([place.exact(one[None]) for one in q])}
    for judge, is_free in judges.items():
        free = is_free(q)
        touches = -STATED if judge == "exact" else 0.0
        missed, own = free & (to_world < touches), free & (to_itself < touches)
        found[judge] = {
            "free": int(free.sum()),
            "near": int((free & (to_world < NEAR)).sum()),
            "missed": int(missed.sum()),
            "deepest_mm": round(-1e3 * float(to_world[missed].min(initial=0.0)), 4),
            "missed_self": int(own.sum()),
            "deepest_self_mm": round(-1e3 * float(to_itself[own].min(initial=0.0)), 3),
        }
    return found


def places(seed: int) -> Iterator[tuple[str, Callable[[], Place]]]:
    """Names of places, and what builds them."""
    for name in ("panda", "ur5e", "fetch"):
        robot = vrrt_jax.load_robot(name)
        rng = np.random.default_rng(seed)
        yield f"{name} random", lambda n=name, r=robot: arm_place(n, random_world(r, 7000 + seed))
        yield (
            f"{name} packaged",
            lambda n=name, r=robot: arm_place(
                n,
                list(vrrt_jax.obstacle_list(vrrt_jax.load_world(f"{n}_{1 + seed % 6}", r))),
            ),
        )
        yield f"{name} small", lambda n=name, r=robot, g=rng: arm_place(n, small_things(r, g))
    for name, problem in (("snake", "home_1"), ("fetch", "home_fetch")):
        yield (
            f"{name} packaged home",
            lambda n=name, p=problem: home_place(n, load_home(p).grid),
        )
        yield (
            f"{name} random home",
            lambda n=name: home_place(n, generate_house(900_000 + seed, n).grid),
        )


def main() -> int:
    """Judge, print a line for each place, and end with 1 if anything was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--paths", type=int, default=1000, help="in all")
    parser.add_argument("--configurations", type=int, default=10_000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="places whose names hold this")
    parser.add_argument("--json", help="write all here")
    arguments = parser.parse_args()
    chosen = [(n, b) for n, b in places(arguments.seed) if arguments.only in n]
    found, wrong = {}, 0
    for name, build in chosen:
        begin = time.perf_counter()
        place = build()
        paths = judge_paths(place, arguments.paths // len(chosen), arguments.seed)
        poses = judge_configurations(place, arguments.configurations // len(chosen), arguments.seed)
        found[name] = {"paths": paths, "configurations": poses}
        seconds = time.perf_counter() - begin
        shown = {k: v for k, v in paths.items() if k != "examples"}
        print(f"{name} ({seconds:.0f} s): {json.dumps(shown)} {json.dumps(poses)}", flush=True)
        judges = [poses[judge] for judge in (*place.covers, "exact")]
        wrong += paths["missed"] + sum(judge["missed"] for judge in judges)
        if arguments.json:
            Path(arguments.json).write_text(json.dumps(found, indent=1))
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
