"""The decomposed planner: legs that keep still what they should, and words for a leg that fails."""

import json

import jax
import numpy as np
import pytest

import nrp_jax
from nrp_jax.cli import main
from nrp_jax.planner import Status, plan
from nrp_jax.planners import hybrid_astar
from nrp_jax.planners.decomposed import BASE, REST
from nrp_jax.planners.hybrid_astar import STEP, drive
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.trajectory import trajectory_of
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.shortcut import path_length

pytestmark = pytest.mark.light_compilation
# A wall across the room, with a door of 0.9 m.
ROOM = np.zeros((40, 40, 20), bool)
ROOM[19:21] = True
DOOR = (slice(19, 21), slice(26, 35))
START = np.array([0.8, 1.0, 0.5, *REST])
GOAL = np.array([3.2, 1.0, -2.0, *REST])
# Its arm at rest, but for a torso and a wrist that straight edges bring there.
STRETCHED = [0.1, *REST[1:-1], 0.8]


@pytest.fixture(scope="module")
def fetch():
    return nrp_jax.load_robot("fetch")


@pytest.fixture(scope="module")
def homes(fetch):
    """The room with its door open and shut; maps begin away from the origin."""
    made = {}
    for name in ("open", "shut"):
        occupied = ROOM.copy()
        occupied[DOOR] = name == "shut"
        grid = nrp_jax.Grid(occupied=occupied)
        made[name] = grid, nrp_jax.build_world(fetch, grid), ExactScene(fetch, grid)
    return made


@pytest.fixture(scope="module")
def way(homes):
    grid, world, _ = homes["open"]
    return drive(world, grid, START.astype(np.float32), GOAL.astype(np.float32))


def test_the_base_drives_through_the_door(homes, way):
    grid, world, _ = homes["open"]
    np.testing.assert_allclose(way.path[[0, -1]], [START, GOAL], atol=1e-6)
    assert way.checked > 0 and not way.is_over and way.search_s > 0
    # Motions are 0.5 m long, as the world itself drives them; the last edge is what is left.
    motions = way.path[:-1]
    assert path_length(world, motions) == pytest.approx(STEP * (len(motions) - 1), abs=1e-3)
    # The disc of 0.3 m keeps away from all that is below 1.1 m.
    along = trajectory_of(world, way.path)
    solid = np.argwhere(grid.occupied.any(axis=2)) * 0.1
    gap = np.maximum(np.maximum(solid - along[:, None, :2], along[:, None, :2] - solid - 0.1), 0)
    assert np.linalg.norm(gap, axis=-1).min() > hybrid_astar.RADIUS - 1e-3
    np.testing.assert_array_equal(along[:, BASE:], np.broadcast_to(REST, (len(along), 8)))


def test_there_is_no_way_through_a_shut_door(homes):
    grid, world, _ = homes["shut"]
    found = drive(world, grid, START.astype(np.float32), GOAL.astype(np.float32))
    assert found.path is None and found.is_over
    with interruptible() as interrupted:
        interrupted.set()
        grid, world, _ = homes["open"]
        found = drive(world, grid, START.astype(np.float32), GOAL.astype(np.float32))
    assert found.path is None and not found.is_over


@pytest.fixture(scope="module")
def solve(fetch, homes):
    def run(home="open", **options):
        grid, world, scene = homes[home]
        ends = (np.append(q[:BASE], STRETCHED) for q in (START, GOAL))
        given = {"world": world, "scene": scene, "key": jax.random.key(0), "lanes": 8}
        given |= {"max_expansions": 400, "time_limit_s": 120.0, **options}
        return plan(fetch, grid, *ends, planner="decomposed", **given)

    return run


def test_each_leg_moves_what_the_others_keep_still(solve):
    result = solve()
    assert result.status is Status.SOLVED and result.verification.ok
    at_rest = np.all(np.abs(result.path[:, BASE:] - REST) < 1e-6, axis=1)
    first, last = np.flatnonzero(at_rest)[[0, -1]]
    assert at_rest[first : last + 1].all() and 0 < first < last < len(result.path) - 1
    for part in (result.path[: first + 1], result.path[last:]):
        assert np.ptp(part[:, :BASE], axis=0).max() < 1e-6
    cost, seconds = result.history[:, 4], result.history[:, 1]
    assert np.all(np.diff(seconds) >= 0) and np.all(np.diff(result.history[:, 5]) >= 0)
    found = cost[np.isfinite(cost)]
    assert len(found) and np.all(np.diff(found) <= 1e-4) and found[-1] >= result.cost - 1e-3
    assert result.history[-1, 0] * 8 == result.expansions <= 400


def test_its_path_is_timed_by_the_command(homes, tmp_path, capsys):
    """With the programs of the test before."""
    homes["open"][0].save(tmp_path / "home.npz")
    ends = {"a": START, "b": GOAL}
    poses = {name: [*map(float, [*q[:BASE], *STRETCHED])] for name, q in ends.items()}
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    command = ["bench", "execution", "--homes", str(tmp_path / "home.npz"), "--budget", "3"]
    command += ["--lanes", "8", "--poses", str(tmp_path / "poses.json")]
    command += ["--json", str(tmp_path / "out.json"), "--planners", "decomposed"]
    assert main(command) == 0
    told = capsys.readouterr().out
    results = json.loads((tmp_path / "out.json").read_text())
    names = ("quickened_s", "execution_s", "stopping_s")
    ((quick,),), ((seconds,),), ((stopping,),) = (results[name] for name in names)
    assert results["legs"] == ["a to b"] and 3.0 < quick < seconds < stopping < 60.0
    assert f"| a to b | {quick:.1f}; {seconds:.1f} ({stopping:.1f}) |" in told
    assert main(command) == 0 and capsys.readouterr().out == told
    assert main([*command[:-1], "rrt,brt"]) == 2
    assert "unknown planner 'brt'; have: rrt, " in capsys.readouterr().err
    assert main([*command, "--homes", "nowhere"]) == 2
    assert "there is no 'nowhere'; expected a map" in capsys.readouterr().err


class Wary(CarWorld):
    """A world in which the torso has to be up."""

    def is_free(self, q):
        """See the world itself."""
        return super().is_free(q) & (q[BASE] > 0.05)


def test_a_leg_that_fails_is_named(solve, homes):
    shut = solve("shut")
    assert shut.status is Status.NO_PATH and not shut.ok
    assert shut.advice.startswith("no way was found for the base with its arm at rest: take a")
    wary = solve(world=Wary(**vars(homes["open"][1])))
    assert wary.status is Status.NO_PATH
    assert wary.advice.startswith("the arm cannot rest at the start, where its rest pose touches")


def test_it_is_for_the_fetch():
    snake, floor = nrp_jax.load_robot("snake"), nrp_jax.Grid(occupied=np.zeros((60, 60), bool))
    q = np.array([3.0, 3.0, 0.3, 0.2, 0.0, 0.1, 0.0, 0.0])
    with pytest.raises(ValueError, match="planner 'decomposed' is for the fetch; 'snake' has: rrt"):
        plan(snake, floor, q, q, key=jax.random.key(0), planner="decomposed")


def test_the_rest_pose_is_free_of_the_robot_itself(homes):
    _, world, scene = homes["open"]
    assert scene.touching(START) == [] and scene.touching(GOAL) == []
    assert np.all(nrp_jax.batch_is_free(world, np.array([START, GOAL], np.float32)))
