"""Rows of whole paths against a plain walk, and which models may learn from them."""

import dataclasses
import json

import numpy as np
import pytest
from nrp_synthetic import between, free, path_lengths

from nrp_jax.cli import main
from nrp_jax.homes.houses import generate_house
from nrp_jax.learning import data, shards
from nrp_jax.learning.batches import load_examples
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.paths import make_path_rows

QUERIES, STATES = 12, 5
TOLERANCE = 2e-3  # of states, [m] and [rad]: lengths are float32


@pytest.fixture(scope="module")
def rows(robot, world, roadmap):
    return make_path_rows(world, robot, roadmap, np.random.default_rng(0), QUERIES, STATES)


def walk(world, roadmap, start, goal, cost):
    """States that part the shortest path from a node to another into equal lengths."""
    nodes = [start]
    while nodes[-1] != goal:
        row = slice(*roadmap.lengths.indptr[nodes[-1] : nodes[-1] + 2])
        joined = roadmap.lengths.indices[row]
        nodes.append(joined[np.argmin(roadmap.lengths.data[row] + cost[joined])])
    for k in range(1, STATES + 1):
        left = cost[start] * k / (STATES + 1)
        for a, b in zip(nodes, nodes[1:], strict=False):
            edge = roadmap.lengths[a, b]
            if left <= edge:
                yield between(world, roadmap.q[a], roadmap.q[b], [left / edge])[0]
                break
            left -= edge


def test_states_lie_evenly_on_shortest_paths(world, roadmap, rows):
    index = {q.tobytes(): i for i, q in enumerate(roadmap.q)}
    assert np.bincount(rows.query).tolist() == [STATES] * QUERIES
    assert np.all(rows.ratio == 1.0) and free(world, rows.waypoint).mean() > 0.98
    for query in range(QUERIES):
        of = np.flatnonzero(rows.query == query)
        start, goal = (index[q[of[0]].tobytes()] for q in (rows.q_start, rows.q_goal))
        cost = path_lengths(roadmap, goal)
        assert rows.length[of] == pytest.approx(cost[start], rel=1e-4)
        for state, expected in zip(
            rows.waypoint[of], walk(world, roadmap, start, goal, cost), strict=True
        ):
            step = np.asarray(world.distance(state, expected.astype(np.float32)))
            assert step < TOLERANCE


def test_each_model_learns_from_its_own_rows_alone(robot, world, rows):
    columns = {**vars(rows), "home": np.zeros(len(rows.ratio), np.int32)}
    settings = shards.DatasetSettings(task="snake", paths=True)
    grids = [generate_house(3).grid]
    dataset = data.Dataset(settings=settings, grids=grids, rows=columns)
    examples = load_examples(ModelConfig.default("snake", "global-cvae"), robot, dataset)
    assert examples.q.shape == (QUERIES, 2 + STATES, 8) and np.all(examples.weight == 1.0)
    for kind in ("cvae", "discriminator"):
        with pytest.raises(ValueError, match=f"holds paths, but a '{kind}' learns from waypoints"):
            load_examples(ModelConfig.default("snake", kind, "map"), robot, dataset)
    dataset = dataclasses.replace(dataset, settings=shards.DatasetSettings(task="snake"))
    with pytest.raises(ValueError, match="holds waypoints, but a 'global-cvae' learns from paths"):
        load_examples(ModelConfig.default("snake", "global-cvae"), robot, dataset)


def test_paths_and_waypoints_never_mix(tmp_path, capsys):
    waypoints = shards.DatasetSettings(task="snake")
    data.write_dataset(tmp_path, waypoints, homes=0, test_homes=0)
    # Sets from before there were paths hold waypoints.
    manifest = json.loads((tmp_path / data.MANIFEST).read_text())
    assert manifest["settings"].pop("paths") is False
    (tmp_path / data.MANIFEST).write_text(json.dumps(manifest))
    data.write_dataset(tmp_path, waypoints, homes=0, test_homes=0)
    command = ["data", "--task", "snake", "--out", str(tmp_path), "--jobs", "1"]
    assert main([*command, "--paths"]) == 2
    assert "was made with paths False, not True" in capsys.readouterr().err
