"""How much of a home a tree sees, and how near the goal it comes."""

import json

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from nrp_jax import build_world, load_robot
from nrp_jax.bench import growth
from nrp_jax.cli import main
from nrp_jax.homes.grid import Grid
from nrp_jax.learning.roadmap import Roadmap


@pytest.fixture(scope="module")
def snake():
    return load_robot("snake")


def test_a_tree_sees_what_no_wall_hides(snake):
    """Two rooms with a door; the snake lies straight, and only its base moves."""
    occupied = np.zeros((80, 80, 1), bool)
    occupied[40, :60] = True  # a wall at x = 4 m, open above y = 6 m
    world = build_world(snake, Grid(occupied=occupied))
    places = [(2.0, 2.0), (2.0, 7.0), (6.0, 7.0), (6.0, 2.0), (6.0, 3.0)]
    q = np.zeros((len(places), 8), np.float32)
    q[:, :2], q[:, 2] = places, np.pi / 2
    # The roadmap leads around the wall; the goal is its last node.
    hops = sparse.csr_matrix(np.diag([5.0, 4.0, 5.0, 1.0], 1))
    roadmap = Roadmap(q=q, lengths=hops + hops.T, colliding=q[:0])
    to_goal = csgraph.dijkstra(roadmap.lengths, indices=4)
    assert to_goal.tolist() == [15.0, 10.0, 6.0, 1.0, 0.0]

    seen, apart = growth.reach(world, roadmap, to_goal, q[:1])
    assert seen == 2 and apart == pytest.approx(15.0, abs=1e-4)  # itself, and up to the door
    seen, apart = growth.reach(world, roadmap, to_goal, q[:2])
    assert seen == 3 and apart == pytest.approx(10.0, abs=1e-4)
    seen, apart = growth.reach(world, roadmap, to_goal, q[:3])
    assert seen == 5 and apart == pytest.approx(4.0, abs=1e-4)  # straight down to the goal


def test_growth_by_command(tmp_path, capsys):
    out = tmp_path / "growth.json"
    short = ["--homes", "1", "--queries", "1", "--nodes", "200", "--max-expansions", "40"]
    command = ["bench", "growth", *short, "--json", str(out)]
    assert main([*command, "--methods", "rrt,nrp-g"]) == 0
    found = json.loads(out.read_text())["methods"]
    for own in found.values():
        assert own["plans"] == 1 and 0 < own["visibility"] <= 200 and own["expansions"] <= 40
        assert own["expansions_per_visibility"] == pytest.approx(
            own["expansions"] / own["visibility"], rel=1e-3
        )
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| rrt |") and "| paper: nrp-d |" in lines[5]
    assert main([*command, "--methods", "rrt-connect"]) == 2
    assert "has not one tree; have: rrt, rrt-is" in capsys.readouterr().err
