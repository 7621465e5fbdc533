"""Plans in homes, from start to goal, each verified by C MuJoCo."""

import json
import signal
import types
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import two_rooms

import nrp_jax
from nrp_jax import planner, viz
from nrp_jax.bench import planning
from nrp_jax.cli import main
from nrp_jax.planner import Status, plan
from nrp_jax.scene import trajectory
from nrp_jax.scene.exact import ExactScene, Verification, verify
from nrp_jax.scene.trajectory import trajectory_of
from vrrt_jax.core.planners import RRTStar
from vrrt_jax.core.search import no_search
from vrrt_jax.core.shortcut import path_length, shortcut
from vrrt_jax.core.types import pytree

START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def home():
    return two_rooms()


@pytest.fixture(scope="module")
def scene(snake, home):
    return ExactScene(snake, home)


@pytest.fixture(scope="module")
def home_world(snake, home):
    return nrp_jax.build_world(snake, home)


@pytest.fixture(scope="module")
def solve(snake, home, scene, home_world):
    def run(method, seed=0, **options):
        return plan(
            snake,
            home,
            START,
            GOAL,
            key=jax.random.key(seed),
            method=method,
            world=home_world,
            scene=scene,
            **{"capacity": 2048, **options},
        )

    return run


@pytree
class Doorman:
    """A sampler that always proposes to stand in the door."""

    door: jax.Array  # (D,)

    def propose(self, world, q_from, q_goal, key):
        """See the samplers."""
        return jnp.broadcast_to(self.door, q_from.shape)


def same_pose(q, other, atol):
    """Equal but for whole turns of joints: paths go on beyond half a turn."""
    off = np.array(q, np.float64) - other
    off[..., 2:] -= 2 * np.pi * np.round(off[..., 2:] / (2 * np.pi))
    np.testing.assert_allclose(off, 0.0, atol=atol)


def check(result, start=START, goal=GOAL):
    assert result.ok and result.verification.ok
    np.testing.assert_array_equal(result.path[0], start)
    same_pose(result.path[-1], goal, atol=1e-5)
    assert result.verification.checked >= len(result.trajectory)
    assert result.raw_path.shape[1] == len(start)


def check_history(result, world):
    """Costs only fall, counts only rise, and the last cost is the length of the path."""
    iteration, seconds, _, nodes, cost, checked = result.history.T
    assert np.isinf(cost[0]) and np.all(cost[1:] <= cost[:-1])
    for column in (iteration, seconds, nodes, checked):
        assert np.all(np.diff(column) >= 0)
    assert checked[0] == 0 and checked[-1] >= iteration[-1]
    assert nodes[-1] == int(result.tree.size)
    np.testing.assert_allclose(cost[-1], path_length(world, result.raw_path), rtol=1e-4)


@pytest.mark.parametrize("method", ["rrt", "rrt-is", "rrt-connect"])
def test_finds_the_door(solve, home_world, method):
    result = solve(method, seed=1)
    check(result)
    in_door = np.abs(result.trajectory[:, 0] - 2.5) < 0.1
    assert np.all((result.trajectory[in_door, 1] > 2.5) & (result.trajectory[in_door, 1] < 3.5))
    assert 4.0 < result.cost < 12.0
    check_history(result, home_world)


def test_the_tree_of_rrt_is_holds(solve, snake, home):
    """Parents come before children, costs add up, and every edge is free."""
    result = solve("rrt-is", max_expansions=256)
    tree = jax.tree.map(np.asarray, result.tree)
    child = np.arange(1, int(tree.size))
    parent = tree.parent[child]
    assert len(child) > 100 and np.all((parent >= 0) & (parent < child))
    world = nrp_jax.build_world(snake, home)
    length = np.asarray(world.distance(tree.q[parent], tree.q[child]))
    np.testing.assert_allclose(tree.cost[child], tree.cost[parent] + length, atol=2e-3)
    middle = world.interpolate(tree.q[parent], tree.q[child], 0.5)
    assert np.mean(nrp_jax.batch_is_free(world, middle)) > 0.995


def test_waypoints_lead_through_the_door(solve):
    door = jnp.asarray([2.5, 3.0, 0.0, 0.8, -0.8, 0.8, -0.8, 0.8])
    result = solve("nrp-d", sampler=Doorman(door=door), goal_bias=1.0, straight_rate=0.0)
    check(result)
    assert result.expansions <= 96


def test_same_key_same_plan(solve):
    """Also on several threads at once, which plan something else meanwhile."""
    first = solve("rrt-connect", 3)
    with ThreadPoolExecutor(3) as pool:
        plans = list(pool.map(partial(solve, "rrt-connect"), [3, 4, 3, 5, 3]))
    for other in plans[::2]:
        np.testing.assert_array_equal(first.path, other.path)
        np.testing.assert_array_equal(first.tree.q, other.tree.q)
    assert not np.array_equal(first.path, plans[1].path)


def test_a_budget_of_expansions_does_not_ask_the_clock(solve):
    """Planners that improve their paths end with it, if time is not up before."""
    budget = {"max_expansions": 640, "time_limit_s": 1e6}
    first, second = solve("bit-star", 3, **budget), solve("bit-star", 3, **budget)
    np.testing.assert_array_equal(first.path, second.path)
    np.testing.assert_array_equal(first.tree.cost, second.tree.cost)
    assert first.expansions == second.expansions


def test_budget_and_capacity(solve):
    assert solve("rrt", max_expansions=32, goal_bias=0.0).status is Status.MAX_ITERATIONS
    assert solve("rrt-is", capacity=64, max_capacity=64, goal_bias=0.0).status is Status.TREE_FULL


def test_rrt_connect_counts_the_lanes_it_takes(solve, monkeypatch):
    class Asked(Exception):
        pass

    def search(world, goal, policy, tree, *, termination, **_):
        raise Asked(policy.lanes, int(termination.max_iterations))

    monkeypatch.setattr(planner, "search", search)
    with pytest.raises(Asked) as asked:
        solve("rrt-connect", lanes=1, max_expansions=64)
    assert asked.value.args == (2, 32)


def test_fetch_drives_and_reaches(snake):
    fetch = nrp_jax.load_robot("fetch")
    occupied = np.zeros((60, 40, 20), bool)
    occupied[28:30, :, :] = True
    occupied[28:30, 20:33, :] = False
    occupied[40:45, 5:10, 6:8] = True  # a table's top
    grid = nrp_jax.Grid(occupied=occupied)
    start = np.array([1.2, 1.2, 0.5, 0.2, 1.3, 1.4, -0.2, 1.5, 0.0, 1.66, 0.0], np.float32)
    goal = np.array([4.6, 2.4, -1.0, 0.3, 0.5, 0.2, 0.0, 0.8, 0.0, 0.5, 0.0], np.float32)
    result = plan(fetch, grid, start, goal, key=jax.random.key(0), capacity=2048)
    check(result, start, goal)
    heading = result.trajectory[:, 2]
    step = np.diff(result.trajectory[:, :2], axis=0)
    turn = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    middle = heading[:-1] + turn / 2
    sideways = np.abs(step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle))
    assert sideways.max() < 2e-3
    assert np.all(np.abs(turn) <= np.linalg.norm(step, axis=1) / 0.095 + 2e-3)
    assert np.abs(turn).max() <= 0.0205  # what the arm holds out is not swept past anything


def test_the_shortest_drive_has_no_shortcuts():
    """Parts of a drive that turns are not as long as their share of it."""
    grid = nrp_jax.Grid(occupied=np.zeros((60, 40, 20)))
    world = nrp_jax.build_world(nrp_jax.load_robot("fetch"), grid)
    start = np.array([2, 2, 1.5, 0.2, 1.3, 1.4, -0.2, 1.5, 0.0, 1.66, 0.0], np.float32)
    goal = np.concatenate([[3, 2.5, -2], start[3:]], dtype=np.float32)
    middle = jax.jit(lambda world, *ends: world.interpolate(*ends, 0.5))(world, start, goal)
    path = np.stack([start, middle, goal])
    np.testing.assert_array_equal(shortcut(world, path, key=jax.random.key(0)), path)


def test_headings_of_a_trajectory_go_on(snake, home):
    world = nrp_jax.build_world(snake, home)
    is_continuous = np.asarray(world.is_continuous)
    assert is_continuous.any()
    ends = np.stack([START, START]).astype(np.float32)
    ends[:, is_continuous] = np.array([[3.0], [-3.0]])
    steps = trajectory_of(world, ends)
    assert np.abs(np.diff(steps, axis=0)).max() <= 0.02 + 1e-5
    np.testing.assert_allclose(steps[-1, is_continuous], 2 * np.pi - 3.0, atol=1e-5)


def test_a_trajectory_of_any_length_compiles_nothing_anew(snake, home):
    world = nrp_jax.build_world(snake, home)
    ends = np.stack([START, GOAL]).astype(np.float32)
    short = trajectory_of(world, ends[:1] + [[0.0], [0.03]] * np.eye(8)[0])
    before = trajectory._interpolate._cache_size()
    far = trajectory_of(world, ends[[0, 1, 0, 1, 0]])
    assert len(short) < trajectory.BLOCK < len(far)
    assert trajectory._interpolate._cache_size() == before
    assert np.abs(np.diff(far, axis=0)).max() <= 0.02 + 1e-5
    np.testing.assert_allclose(far[[0, -1]], ends[[0, 0]], atol=1e-5)


def test_verification_sees_what_is_wrong(snake, home, scene, solve):
    world = nrp_jax.build_world(snake, home)
    limits = {"lower": np.asarray(world.lower), "upper": np.asarray(world.upper)}
    through = trajectory_of(world, np.stack([START, GOAL]))
    assert "touches the map" in verify(scene, through, **limits).contact
    gap = np.stack([START, START + 0.05])
    assert "gap" in verify(scene, gap, **limits).contact
    outside = np.array(START)[None] - [6, 0, 0, 0, 0, 0, 0, 0]
    assert "x leaves its limits" in verify(scene, outside, **limits).contact
    curled = np.array([1.0, 1.0, 0, 2.6, 2.6, 2.6, 2.6, 2.6])[None]
    assert "touches link" in verify(scene, curled, **limits).contact


def test_sideways_is_seen():
    fetch = nrp_jax.load_robot("fetch")
    grid = nrp_jax.Grid(occupied=np.zeros((60, 60, 20)))
    slide = np.zeros((5, 11))
    slide[:, :2], slide[:, 3] = 3.0, 0.2
    slide[:, 1] += 0.02 * np.arange(5)
    lower, upper = np.full(11, -9.0), np.full(11, 9.0)
    found = verify(ExactScene(fetch, grid), slide, lower=lower, upper=upper)
    assert "sideways" in found.contact


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q_start": START[:5]}, r"the start has shape \(5,\); expected \(8,\): x, y"),
        ({"q_start": START + 50}, r"the start's x is 51.0; the map spans \[0.000, 5.000\]"),
        ({"q_goal": np.full(8, np.nan)}, "the goal's x is nan"),
        ({"q_goal": np.r_[2.5, 1.0, START[2:]]}, "the goal is not free: .* touches the map at"),
        ({"planner": "prm"}, "unknown planner 'prm'; have: rrt, rrt-is"),
        ({"method": "prm"}, "unknown planner 'prm'; have: rrt, rrt-is"),
        ({"planner": object()}, "the planner object lacks edge_steps, lanes, init"),
        ({"max_iterations": 3}, "unknown settings max_iterations; have: goal_bias"),
        (
            {"method": "nrp-g", "sampler": nrp_jax.load_sampler("snake", "discriminator")},
            "the sampler is the discriminator of 'snake'; expected the cvae",
        ),
        ({"goal_bias": 2.0}, r"goal_bias=2.0 is out of range; expected \[0.0, 1.0\]"),
        ({"max_expansions": 0}, "max_expansions=0 is out of range; expected"),
        ({"capacity": 33}, "capacity is 33; expected at least 34"),
    ],
)
def test_bad_input(snake, home, scene, change, message):
    arguments = {"q_start": START, "q_goal": GOAL, "key": jax.random.key(0), **change}
    with pytest.raises(ValueError, match=message):
        plan(snake, home, scene=scene, **arguments)


def test_command_line(tmp_path, home, capsys, monkeypatch):
    home.save(tmp_path / "home.npz")
    out = tmp_path / "out"
    numbers = [",".join(str(float(v)) for v in q) for q in (START, GOAL)]
    command = ["plan", "--map", str(tmp_path / "home.npz"), f"--start={numbers[0]}"]
    command += [f"--goal={numbers[1]}", "--capacity", "2048", "--out", str(out)]
    assert main(command) == 0
    record = json.loads((out / "path.json").read_text())
    assert record["status"] == "SOLVED" and record["verified"]
    assert len(record["trajectory"]) > len(record["path"]) > 1
    assert (out / "plan.png").stat().st_size > 10_000
    assert main([*command, "--start=1,2"]) == 2
    assert "the start has shape" in capsys.readouterr().err

    def without_matplotlib(*_):
        raise ModuleNotFoundError("No module named 'matplotlib'")

    monkeypatch.setattr(viz, "save_plan", without_matplotlib)
    assert main(command) == 0
    told = capsys.readouterr()
    assert told.out.startswith("SOLVED") and "vrrt-jax[plot]" in told.err


def test_a_refused_path_is_told(solve, monkeypatch):
    """The tree's own path stands in for the short one; with both refused, that is the outcome."""
    seen = []

    def refuse(scene, trajectory, **limits):
        seen.append(trajectory)
        return Verification(ok=len(seen) == accepted, checked=1, contact="touches")

    monkeypatch.setattr(planner, "verify", refuse)
    accepted = 2
    result = solve("rrt-connect")
    assert result.ok and len(seen) > 2  # parts are asked for too
    same_pose(result.path, result.raw_path, atol=1e-5)
    accepted = 0
    result = solve("rrt-connect")
    assert result.status is Status.NOT_VERIFIED and len(result.path) > 1


def test_an_interrupted_bench_ends(snake, home, scene, monkeypatch):
    asked = planning.Home(
        seed=0, grid=home, world=None, scene=scene, starts=START[None], goals=GOAL[None]
    )

    def interrupted(*_, **__):
        signal.raise_signal(signal.SIGINT)  # a flag while something plans
        return types.SimpleNamespace(status=Status.SOLVED)

    monkeypatch.setattr(planning, "plan", interrupted)
    budget = {"max_expansions": 10, "lanes": 10, "goal_bias": 0.1, "straight_rate": 0.2}
    with pytest.raises(KeyboardInterrupt):
        planning.run(snake, [asked], "rrt", None, **budget, on_result=pytest.fail)


def test_bench_counts_verified_plans(snake, home, scene, tmp_path, monkeypatch, capsys):
    world = nrp_jax.build_world(snake, home)
    ends = np.stack([START, GOAL])
    asked = planning.Home(
        seed=0, grid=home, world=world, scene=scene, starts=ends, goals=ends[::-1]
    )
    monkeypatch.setattr(planning, "unseen_homes", lambda *_: [asked])
    out = tmp_path / "plan.json"
    command = ["bench", "plan", "--homes", "1", "--queries", "2", "--json", str(out)]
    assert main([*command, "--methods", "rrt-connect", "--max-expansions", "4000"]) == 0
    found = json.loads(out.read_text())["methods"]["rrt-connect"]
    assert found["n"] == 2 and found["success"] == 1.0 and found["not_verified"] == 0
    assert 0 < found["median_expansions"] <= 4000 and found["mean_cost_m"] > 3.0
    assert main([*command, "--methods", "rrt-connect", "--max-expansions", "10"]) == 0
    assert json.loads(out.read_text())["methods"]["rrt-connect"]["success"] == 0.0
    few = ["--methods", "rrt-connect,rrt,nrp-g", "--max-expansions", "10"]
    assert main([*command, *few, "--goal-bias", "0.1", "1", "--straight-rate", "0", "0.5"]) == 0
    assert [*json.loads(out.read_text())["methods"]] == [
        "rrt-connect",
        *("rrt goal_bias=0.1", "rrt goal_bias=1"),
        *("nrp-g goal_bias=0.1 straight_rate=0", "nrp-g goal_bias=0.1 straight_rate=0.5"),
        *("nrp-g goal_bias=1 straight_rate=0", "nrp-g goal_bias=1 straight_rate=0.5"),
    ]
    assert main([*command, "--methods", "prm"]) == 2
    assert "unknown planner 'prm'; have: rrt, rrt-is" in capsys.readouterr().err


def test_an_optimal_planner_and_a_goal_of_ones_own(snake, home, scene):
    """RRT* ends by its budget, and a goal keeps its own threshold."""
    near = START.copy()
    near[0] += 0.4
    goal = nrp_jax.ConfigurationGoal(q=near, threshold=0.05)
    planner = RRTStar(goal_bias=0.3, keep_partial=True, edge_steps=64, lanes=8)
    run: dict = {"key": jax.random.key(0), "scene": scene}
    result = plan(snake, home, START, goal, planner=planner, max_expansions=80, **run)
    assert result.ok and result.match_threshold == 0.05
    assert result.expansions == 80
    with pytest.raises(ValueError, match="got both planner and method"):
        plan(snake, home, START, near, planner="rrt", method="nrp-d", **run)
    with pytest.raises(ValueError, match="capacity is 20; expected at least 34"):
        plan(snake, home, START, near, capacity=20, **run)


def test_restarts_ask_the_exact_check_for_parts_of_paths(solve, monkeypatch):
    """A part need not begin where the path does."""
    verdicts = []

    def ask(world, goal, policy, tree, *, accept, **options):
        path = np.linspace(START, GOAL, 5).astype(np.float32)  # through the wall at x = 2.5
        verdicts.extend(accept(part) for part in (path[:2], path[3:], path[1:3]))
        return no_search(policy, goal, tree), None

    monkeypatch.setattr(planner, "search_with_restarts", ask)
    assert not solve("nrp-star-connect").ok
    assert verdicts == [True, True, False]


def test_a_path_whose_shortcuts_are_refused_is_shortened_in_parts(solve, home_world, monkeypatch):
    asked = []

    def refuse_the_first(*arguments, **limits):
        asked.append(verify(*arguments, **limits))
        return asked[-1] if len(asked) > 1 else Verification(ok=False, checked=1, contact="a wall")

    monkeypatch.setattr(planner, "verify", refuse_the_first)
    result = solve("rrt-connect")
    assert result.ok and result.refused == 1 and len(asked) > 3
    assert result.cost < 0.95 * path_length(home_world, result.raw_path)
