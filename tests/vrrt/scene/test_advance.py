"""The exact check misses nothing thin, however far the arm reaches, in any thread."""

import copy
import dataclasses
import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.scene import exact
from vrrt_jax.scene.advance import FINEST, NEAR, first_touch, near_pairs

CASES = Path(__file__).parents[2] / "cases" / "arms"
EGG = vrrt_jax.Obstacle(name="egg", kind="sphere", position=(0, 0, 0.1), size=(0.02, 0, 0))


@pytest.fixture(scope="module")
def needle():
    """A tool of 1 mm at the end of a boom of 1.8 m."""
    return vrrt_jax.load_robot(CASES / "16_thin_sheet_tunnelled" / "sheet.xml")


def sheet(angle, half, reach=1.8):
    return vrrt_jax.Obstacle(
        name="sheet",
        kind="box",
        position=(reach * np.cos(angle), reach * np.sin(angle), 0.0),
        quaternion=(np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)),
        size=(0.1, half, 1.0),
    )


def test_no_sheet_is_passed_through(needle, rng):
    for half in (5e-5, 2e-4, 5e-4, 2e-3, 5e-3):
        for angle in rng.uniform(0.1, 1.1, 20):
            path = np.array([[0.0, rng.uniform(-0.2, 0.2)], [1.2, rng.uniform(-0.2, 0.2)]])
            found = vrrt_jax.verify_path(needle, [sheet(angle, half)], path)
            assert not found.ok and "needle touches sheet" in str(found.contact)


@pytest.mark.light_compilation
def test_a_plan_around_a_thin_sheet_counts_the_paths_that_were_refused(needle):
    """The planner's coarse steps pass through it; finer ones find the way above or below."""
    low = dataclasses.replace(sheet(0.5, 5e-4), size=(0.1, 5e-4, 0.06))
    world = vrrt_jax.build_world(needle, [low], engine="closed_form")
    refused = 0
    for seed in range(4):
        key = jax.random.key(seed)
        result = vrrt_jax.plan_to_configuration(needle, world, [0, 0], [1.2, 0], key=key)
        assert result.ok
        assert vrrt_jax.verify_path(needle, world, result.path, step=2e-4).ok
        refused += result.refused
    assert refused > 0


def test_thin_rods_and_balls_in_the_way_of_the_panda_are_met(panda, rng):
    """Wherever a link is half-way, something tiny at that place is met."""
    for _ in range(15):
        path = np.clip(panda.home + rng.normal(0, 0.6, (2, 7)), panda.lower, panda.upper)
        scene = exact.exact_scene(panda, [], geometry="spheres")
        if not vrrt_jax.verify_path(panda, [], path, geometry="spheres").ok:
            continue
        scene.near(path[0] + rng.uniform(0.2, 0.8) * (path[1] - path[0]))
        place = scene.data.geom_xpos[rng.choice(scene.robot_geoms)]
        dot = vrrt_jax.Obstacle(
            name="dot", kind="sphere", position=tuple(place), size=(2e-4, 0.0, 0.0)
        )
        assert not vrrt_jax.verify_path(panda, [dot], path, geometry="spheres").ok


def test_all_pairs_nearer_than_the_margins_are_reported_and_no_others(panda, rng):
    world = vrrt_jax.load_problem("panda_posts", engine="closed_form").world
    scene = exact.exact_scene(panda, world, geometry="spheres")
    wider = copy.copy(scene.model)
    wider.geom_margin[:] = NEAR
    data, count = mujoco.MjData(wider), 0
    for q in rng.uniform(panda.lower, panda.upper, (100, panda.num_joints)):
        found, (all_found, _) = np.sort(scene.near(q)[0]), near_pairs(wider, data, q)
        assert found.max(initial=0.0) <= NEAR
        np.testing.assert_allclose(found, np.sort(all_found[all_found <= NEAR]), atol=1e-9)
        count += len(found)
    assert count > 100


def test_steps_follow_distances():
    """One joint of a meter's reach: far away long steps, near by no less than the finest."""
    arms = np.array([[[0.0, 1.0], [1.0, 0.0]]])
    pair = np.array([[0, 1]])

    def checked(distance):
        seen = []

        def near(q):
            seen.append(float(q[0]))
            return np.array([distance]), pair

        assert first_touch(near, arms, np.zeros(1), np.ones(1), step=0.005)[0] is None
        return np.diff(seen)

    np.testing.assert_allclose(checked(0.02), 0.02, rtol=1e-6)
    np.testing.assert_allclose(checked(0.002), 0.002, rtol=1e-6)
    np.testing.assert_allclose(checked(1e-5), FINEST, rtol=1e-6)


def test_threads_with_different_robots_worlds_and_held_objects(panda, needle, rng):
    world = vrrt_jax.load_problem("panda_posts", engine="closed_form").world
    holding = vrrt_jax.attach(world, EGG, "hand")
    jobs = []
    for k in range(24):
        far = np.clip(panda.home + rng.normal(0, 0.5, 7), panda.lower, panda.upper)
        where = (world, holding, vrrt_jax.obstacle_list(world)[:2])[k % 3]
        jobs.append((panda, where, np.stack([panda.home, far]), "spheres"))
        jobs.append((needle, [sheet(0.2 + k / 30, 5e-4)], np.array([[0, 0], [0.6, 0.1]]), "auto"))

    def check(job):
        robot, where, path, geometry = job
        return repr(vrrt_jax.verify_path(robot, where, path, geometry=geometry))

    expected = [check(job) for job in jobs]
    assert len(set(expected)) > 10
    for workers in (2, 8):
        with ThreadPoolExecutor(workers) as pool:
            assert list(pool.map(check, jobs * 2)) == expected * 2


def test_a_scene_may_be_handed_to_another_thread(needle):
    scene = exact.exact_scene(needle, [sheet(0.5, 1e-3)])
    here, there = [], []
    thread = threading.Thread(target=lambda: there.append((scene.data, scene.touching([0.5, 0]))))
    thread.start()
    thread.join()
    here.append((scene.data, scene.touching([0.5, 0])))
    assert here[0][1] == there[0][1] != [] and here[0][0] is not there[0][0]


def test_threads_that_ended_leave_nothing(needle):
    kept = []

    def work():
        kept.append(weakref.ref(exact.exact_scene(needle, []).compiled))

    for _ in range(30):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    gc.collect()
    assert len(kept) == 30 and all(reference() is None for reference in kept)
