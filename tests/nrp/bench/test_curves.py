"""Curves of real planners in a tiny home, resumed from files that were cut; and what they tell."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from nrp_synthetic import two_rooms

import nrp_jax
from nrp_jax.bench import curve_homes, ompl_peers
from nrp_jax.bench.curve_rows import row_of
from nrp_jax.bench.curve_stats import curves, grid_to, references
from nrp_jax.cli import main
from nrp_jax.scene.exact import ExactScene

pytestmark = pytest.mark.light_compilation

POSES = {
    "left": [1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9],
    "right": [4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5],
}


@pytest.fixture(scope="module")
def home():
    return two_rooms()


@pytest.fixture(scope="module")
def folder(home, tmp_path_factory):
    """A map, and a file of poses beside it."""
    folder = tmp_path_factory.mktemp("curves")
    home.save(folder / "home.npz")
    (folder / "poses.json").write_text(json.dumps({"order": ["x", "y"], **POSES}))
    return folder


@pytest.fixture(scope="module")
def command(folder):
    return [
        *("bench", "curves", "--homes", str(folder / "home.npz"), "--budget", "20"),
        *("--poses", str(folder / "poses.json"), "--planners", "rrt-connect"),
    ]


@pytest.fixture(scope="module")
def measured(folder, command):
    """The file of a whole run."""
    file = folder / "curves.json"
    assert main([*command, "--nodes", "500", "--json", str(file)]) == 0
    return file


def test_a_run_tells_curves(measured):
    results = json.loads(measured.read_text())
    found = results["planners"]["rrt-connect"]
    assert found["n"] == 2 and found["success"][-1] == 1.0 and found["not_verified"] == 0
    for part in (found, found["expansions"], found["checks"]):
        at = part["time_s" if part is found else "at"]
        for name in ("success", "success_deviation", "optimality", "optimality_deviation"):
            assert len(part[name]) == len(at)
        assert 0 < part["optimality"][-1] <= part["success"][-1] == 1.0
    assert found["time_s"][-1] == 20.0 and 0 < found["median_first_s"] < 20.0
    # Both poses are free: the queries are there and back, on one shortest path.
    assert results["labels"] == {"home.npz": ["left to right", "right to left"]}
    assert results["poses"]["home.npz"] == {"poses_moved": {}, "poses_refused": {}}
    there, back = results["reference"]["roadmaps"]["home.npz"]
    assert there == pytest.approx(back, rel=1e-3) and there > 3.0
    assert results["machine"]["cores"] and results["seed"] == 0 and results["command"]


def test_a_run_that_was_cut_goes_on(measured, command, capsys):
    rows = measured.with_name(f"{measured.name}.rows")
    whole = rows.read_text().splitlines()
    rows.write_text("\n".join(whole)[:-20])  # killed while it wrote the last row
    more = [*command, "--nodes", "500", "--json", str(measured)]
    assert main([*more[:-4], "--runs", "2", *more[-4:]]) == 0
    lines = rows.read_text().splitlines()
    assert lines[: len(whole) - 1] == whole[:-1]  # nothing is lost
    keys = [
        tuple(json.loads(line)[k] for k in ("planner", "home", "query", "run"))
        for line in lines[1:]
    ]
    assert len({*keys}) == len(keys) == 5  # nothing is counted twice: a roadmap and 2 x 2 plans
    assert json.loads(measured.read_text())["planners"]["rrt-connect"]["n"] == 4
    capsys.readouterr()
    assert main([*more, "--seed", "1"]) == 2
    assert "has seed 0, this run 1: results of different runs are not mixed" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--planners", "rrt,brt"], "unknown planner 'brt'; have: rrt, "),
        (["--homes", "nowhere"], "there is no 'nowhere'; expected test, a folder of maps"),
        (["--poses", "poses.json"], "--poses are of a map; give the map"),
        (["--poses-key", "left"], "give it with --poses"),
        (["--budget", "0"], "expected a number from 0.01"),
        (["--homes", "home.npz", "--poses", "poses.json", "--poses-key", "up"], "has no 'up'"),
        (["--homes", "home.npz", "--poses", "home.npz"], "pose 'occupied 0'"),
        (["--homes", "home.npz", "--poses", "short.json"], "has 1 poses; expected two at least"),
        (["--homes", "home.npz", "--poses", "text.json"], "holds no poses"),
        (
            ["--homes", "long.npz", "--poses", "poses.json", "--planners", "rrt,next"],
            "next in 'long.npz': the map has 120 x 40 cells; networks that see the whole map",
        ),
        (
            ["--homes", "home.npz", "--task", "fetch"],
            "'home.npz': this robot needs a map with heights",
        ),
    ],
)
def test_bad_options_are_told_in_one_line(options, words, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    (folder / "short.json").write_text(json.dumps({"left": POSES["left"]}))
    (folder / "text.json").write_text("left: 1, 2")
    nrp_jax.Grid(occupied=np.zeros((120, 40), bool)).save(folder / "long.npz")
    assert main(["bench", "curves", *options]) == 2
    told = capsys.readouterr().err.splitlines()
    assert words in told[-1] and not any("Traceback" in line for line in told)


def test_a_pose_that_is_refused_moves_and_is_told(home):
    robot = nrp_jax.load_robot("snake")
    grid = home.flatten()
    poses = {name: np.array(q) for name, q in POSES.items()}
    poses["wall"] = np.array([2.34, 1.0, -1.2, *POSES["left"][3:]])  # the base, by 1 cm
    poses["outside"] = np.array([9.0, 1.0, *POSES["left"][2:]])
    found = curve_homes._with_poses(robot, "home", grid, poses, 50, legs=False)
    assert [*found.notes["poses_moved"]] == ["wall"]
    assert "touches the map" in found.notes["poses_moved"]["wall"]["refused"]
    moved = np.array(found.notes["poses_moved"]["wall"]["instead"])
    assert np.abs(moved - poses["wall"])[:2].max() < 0.05
    assert "the map spans" in found.notes["poses_refused"]["outside"]
    assert len(found.labels) == 6 and "left to wall" in found.labels


def test_curves_count_what_is_known_by_then():
    steps = [[0.3, 64.0, 900.0, 8.0], [1.5, 640.0, 9000.0, 5.0]]
    solved = {"home": "a", "run": 0, "solved": True, "status": "SOLVED", "refused": 0}
    rows = [
        {**solved, "query": 0, "cost": 4.0, "steps": steps},
        {**solved, "query": 1, "cost": 9.0, "steps": [[0.1, 32.0, 500.0, 9.0]]},
        {**solved, "query": 2, "solved": False, "status": "NOT_VERIFIED", "cost": None,
         "refused": 3, "steps": steps},
        {**solved, "query": 3, "solved": False, "status": "TIME_LIMIT", "cost": None, "steps": []},
    ]  # fmt: skip
    reference = references(rows, {"a": [None, 4.5, 1.0, None]})
    assert reference == {"a": [4.0, 4.5, 1.0, None]}
    grids = {"time_s": [0.1, 1.0, 2.0], "expansions": [32, 64], "checks": [100, 1000]}
    found = curves(rows, reference, grids)
    assert found["success"] == [0.25, 0.5, 0.5]
    assert found["optimality"] == [0.125, 0.25, pytest.approx((0.8 + 0.5) / 4)]
    assert found["expansions"]["success"] == [0.25, 0.5] and found["checks"]["success"] == [0, 0.5]
    assert found["median_first_s"] is None  # one would be between the second and no path at all
    assert found["not_verified"] == 1 and found["refused"] == 3
    assert found["optimality_shortened"] == pytest.approx((1.0 + 0.5) / 4)
    assert grid_to(3.0, 0.1) == [0.1, 0.2, 0.5, 1.0, 2.0, 3.0] and grid_to(0.05, 0.1) == [0.05]


def test_the_time_of_refused_paths_counts(home):
    """A second search, whose clock begins at zero, comes after the first one."""
    robot = nrp_jax.load_robot("snake")
    start, goal = (np.array(q) for q in POSES.values())
    result = nrp_jax.plan(robot, home, start, goal, key=jax.random.key(0), planner="rrt-connect")
    alone = row_of(result)
    later = {**result.timing, "search_s": result.timing["search_s"] + 5.0}
    later = row_of(dataclasses.replace(result, timing=later))
    assert alone["solved"] and len(alone["steps"]) == 1
    assert later["steps"][0][0] == pytest.approx(alone["steps"][0][0] + 5.0, abs=1e-3)
    assert alone["steps"][0][1] == result.expansions and alone["checks"] > 0


def test_a_report_draws_what_was_measured(measured, tmp_path, capsys):
    assert main(["report", str(measured), "--out", str(tmp_path)]) == 0
    page = (tmp_path / "README.md").read_text()
    assert "| rrt-connect |" in page and "| nrp-d | 74 |" in page  # ours, and the authors'
    assert (tmp_path / "curves_0_curves.png").stat().st_size > 10_000
    (tmp_path / "other.json").write_text("{}")
    capsys.readouterr()
    assert main(["report", str(tmp_path / "other.json"), "--out", str(tmp_path)]) == 2
    assert "is no results file of nrp bench curves" in capsys.readouterr().err


def test_peers_solve_what_is_easy(home):
    """Paths of OMPL through the door, judged by C MuJoCo."""
    pytest.importorskip("ompl")
    robot = nrp_jax.load_robot("snake")
    ends = (np.array(q) for q in POSES.values())
    problem = (robot, nrp_jax.build_world(robot, home), ExactScene(robot, home), *ends)
    key = jax.random.key(0)
    row = ompl_peers.solve(*problem, name="RRTConnect", budget_s=60.0, key=key)
    assert row["solved"] and 3.0 < row["cost"] <= row["steps"][0][3] + 1e-3
    assert row["checks"] > row["expansions"] > 0 and len(row["steps"]) == 1
    row = ompl_peers.solve(*problem, name="InformedRRTstar", budget_s=3.0, key=key)
    costs = [step[3] for step in row["steps"]]
    assert costs == sorted(costs, reverse=True) and row["search_s"] >= 3.0
