"""Visual-RRT: the frontier's law, Adam along a lineage, no re-compilation, a plan from a picture.

Goal images here are rendered by the self-model, which is quick and needs no OpenGL; the packaged
problems, whose images are MuJoCo's, are planned in test_cli.py.
"""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import vrrt_jax
from vrrt_jax import planner
from vrrt_jax.core import search as searches
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import free_prefix
from vrrt_jax.core.expand import expand
from vrrt_jax.core.rewire import with_costs
from vrrt_jax.core.tree import UNREACHED, lineage
from vrrt_jax.splat.loss import goal_loss, weighted_goal, weighted_image
from vrrt_jax.visual.goal import Sight, visual_policy, visual_setup
from vrrt_jax.visual.policy import finish, plant
from vrrt_jax.visual.polish import LOOKS, _at_hand, look_at, polish

Q_START = np.array([-0.9, 0.5, 0.0, -1.6, 0.0, 2.0, 0.8], np.float32)
Q_GOAL = np.array([-0.5, 0.3, 0.2, -1.9, 0.1, 2.2, 0.6], np.float32)
HALF_TURNED = Q_GOAL - np.pi * np.eye(7, dtype=np.float32)[6]
# Of the default's shapes, and seen by a packaged problem's camera: most programs compile once for
# all tests that plan.
QUICK = planner.PlannerConfig(probe_rounds=1, probe_steps=20, max_iterations=150)


@pytest.fixture(scope="module")
def self_model(panda):
    return vrrt_jax.load_self_model(vrrt_jax.problems.self_model_path(panda))


@pytest.fixture(scope="module")
def camera():
    return vrrt_jax.load_problem("panda_posts").cameras[0]


def picture(panda, self_model, camera, q, level=1):
    splats = self_model.levels[level].splats
    poses = vrrt_jax.link_poses(panda.chain, jnp.asarray(q))
    rgb, alpha = jax.jit(vrrt_jax.render)(splats, poses, camera)
    straight = rgb / jnp.maximum(alpha, 1e-3)[..., None]
    return np.clip(np.concatenate([straight, alpha[..., None]], axis=-1), 0, 1)


@pytest.fixture(scope="module")
def image(panda, self_model, camera):
    return picture(panda, self_model, camera, Q_GOAL)


@pytest.fixture(scope="module")
def open_world(panda):
    ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=(0, 0.9, 0.9), size=(0.1, 0, 0))
    return vrrt_jax.build_world(panda, [ball])


@pytest.fixture(scope="module")
def policy(panda, self_model, camera, image):
    sight = Sight(panda, self_model, camera, image)
    setup = visual_setup(sight, Q_START, dataclasses.replace(QUICK, probes=0))
    return setup.policy, setup.probing


def grown(world, policy, iterations, **changes):
    policy, probing = policy
    policy = dataclasses.replace(policy, **changes)
    tree = plant(world, policy, probing, Q_START[None], jax.random.key(1), 1024)
    step = jax.jit(expand)
    for _ in range(iterations):
        tree = step(world, policy, tree, jax.random.key(0))
    return tree, policy


def test_frontier_law(policy):
    visual, _ = policy
    for m, eta, kappa in ((1, 0.7, 0.9), (40, 1.0, 0.9), (40, 0.4, 0.5)):
        visual = dataclasses.replace(
            visual, eta=jnp.float32(eta), kappa=jnp.float32(kappa), lanes=1
        )
        order = jax.random.permutation(jax.random.key(1), 64)
        score, allowed = jnp.argsort(order).astype(jnp.float32), jnp.zeros(64, bool)
        allowed = allowed.at[order[:m]].set(True)
        keys = jax.random.split(jax.random.key(0), 20_000)
        node, ok = jax.vmap(lambda key: visual._draw(score, allowed, key))(keys)  # noqa: B023
        assert bool(jnp.all(ok))
        rank = np.asarray(score, int)[np.asarray(node[:, 0])]
        share = np.bincount(rank, minlength=64) / len(keys)
        k = np.arange(m)
        law = eta * (1 - kappa) * kappa**k / (1 - kappa**m) + (1 - eta) / m
        assert law.sum() == pytest.approx(1)
        np.testing.assert_allclose(share[:m], law, atol=0.012)
        assert share[m:].sum() == 0


def test_draws_are_distinct_and_reported_when_they_run_out(policy):
    visual, _ = policy
    node, ok = visual._draw(jnp.zeros(64), jnp.arange(64) < 5, jax.random.key(0))
    assert int(ok.sum()) == 5
    assert sorted(np.asarray(node)[np.asarray(ok)]) == [0, 1, 2, 3, 4]


def test_a_branch_without_exploration_is_plain_adam(policy, open_world):
    tree, visual = grown(
        open_world,
        policy,
        6,
        exploration=jnp.float32(0),
        kappa=jnp.float32(0.0),
        eta=jnp.float32(1.0),
        anneal_loss=jnp.float32(0),
        rewiring=False,
    )
    adam = optax.scale_by_adam(b1=0.9, b2=0.9)
    gradient = jax.jit(jax.grad(lambda q: visual.loss(open_world, q)))
    q, state = jnp.asarray(Q_START), adam.init(jnp.asarray(Q_START))
    chain = [q]
    for _ in range(6):
        direction, state = adam.update(gradient(q), state)
        q = q - 0.04 * direction
        chain.append(q)
    exploited = [int(np.argmax(np.asarray(tree.payload.adam.count[: int(tree.size)])))]
    nodes = lineage(tree, exploited[0])
    count = np.asarray(tree.payload.adam.count)[nodes]
    np.testing.assert_array_equal(count, np.arange(len(nodes)))
    np.testing.assert_allclose(np.asarray(tree.q)[nodes], chain[: len(nodes)], atol=2e-3)
    assert len(nodes) >= 4


def test_explored_children_start_fresh_and_step_epsilon(policy, open_world):
    tree, _ = grown(open_world, policy, 4, exploration=jnp.float32(1.0), rewiring=False)
    size = int(tree.size)
    assert size == 1 + 4 * QUICK.lanes
    assert np.all(np.asarray(tree.payload.adam.count[:size]) == 0)
    assert np.all(np.asarray(tree.payload.adam.mu[:size]) == 0)
    step = np.linalg.norm(tree.q[1:size] - tree.q[tree.parent[1:size]], axis=1)
    assert np.all(step < 0.04 + 1e-5) and np.median(step) > 0.0399
    assert not np.any(tree.payload.exploited)


def test_stored_gradients_are_those_of_the_loss(policy, open_world):
    tree, visual = grown(open_world, policy, 3)
    size = int(tree.size)
    expected = jax.jit(jax.vmap(jax.grad(lambda q: visual.loss(open_world, q))))(tree.q[:size])
    np.testing.assert_allclose(tree.payload.grad[:size], expected, rtol=2e-3, atol=1e-5)


def test_costs_stay_right_under_rewiring(policy, open_world):
    tree, _ = grown(open_world, policy, 12)
    np.testing.assert_allclose(with_costs(open_world, tree).cost, tree.cost, atol=2e-4)


def test_probes_are_free_near_and_look_alike_and_evolve(
    panda, self_model, camera, image, wall_world, free
):
    q_roots = Q_START[None]

    def probes(rounds):
        config = dataclasses.replace(QUICK, probe_steps=0, probe_rounds=rounds)
        setup = visual_setup(Sight(panda, self_model, camera, image), Q_START, config)
        probing = setup.probing
        key = jax.random.key(0)
        tree = plant(wall_world, setup.policy, probing, q_roots, key, config.capacity)
        assert np.all(np.asarray(tree.cost[1:64]) == UNREACHED) and float(tree.cost[0]) == 0
        roots = np.asarray(tree.q[1 : int(tree.size)])
        assert len(roots) == 63
        assert np.all(np.asarray(free(wall_world, roots)))
        return roots, probing

    first, probing = probes(rounds=0)
    evolved, _ = probes(rounds=3)
    assert np.linalg.norm(first - Q_START, axis=1).max() <= 2.8 + 1e-4
    others = panda.lower + np.random.default_rng(0).random((64, 7)) * (panda.upper - panda.lower)
    loss = jax.jit(jax.vmap(lambda q: probing.policy.loss(wall_world, q)))
    assert np.median(loss(first)) < np.median(loss(others.astype(np.float32)))
    assert np.mean(loss(evolved)) < 0.9 * np.mean(loss(first))


def test_plan_finds_the_pose_and_new_numbers_do_not_retrace(
    panda, self_model, camera, image, open_world, monkeypatch
):
    traces = []
    original = searches.run_chunk

    def counted(*args):
        traces.append(1)
        return original(*args)

    monkeypatch.setattr(searches, "_chunk", jax.jit(counted))

    def run(world=open_world, image=image, q_start=Q_START, model=self_model, **changes):
        return vrrt_jax.plan(
            panda,
            world,
            model,
            camera,
            image,
            q_start,
            key=jax.random.key(0),
            config=planner.PlannerConfig(**changes),
        )

    result = run()
    assert result.ok and result.verification is not None and result.verification.ok
    assert np.abs(result.q_goal - Q_GOAL).mean() < 0.05
    np.testing.assert_allclose(result.path[0], Q_START, atol=1e-6)
    again = run()
    np.testing.assert_array_equal(result.path, again.path)

    moved = vrrt_jax.move_obstacle(open_world, "ball", position=(0.0, -0.9, 0.9))
    lighter = dataclasses.replace(
        self_model,
        levels=tuple(
            dataclasses.replace(
                level, splats=dataclasses.replace(level.splats, rgb=0.9 * level.splats.rgb)
            )
            for level in self_model.levels
        ),
    )
    before = len(traces)  # one of the visual search, one of the connection to its match
    assert before <= 2
    few = {"max_iterations": 4, "attempts": 1, "polish_rounds": 1}
    run(world=moved, **few)
    run(image=picture(panda, self_model, camera, Q_GOAL + 0.1), **few)
    run(q_start=Q_START + 0.1, **few)
    run(model=lighter, **few)
    run(alpha=0.02, epsilon=0.1, kappa=0.5, eta=0.3, exploration=0.5, beta1=0.5, **few)
    assert len(traces) == before
    run(lanes=4, **few)
    assert len(traces) > before


def test_batch_equals_single_plans(panda, self_model, camera, image, open_world):
    config = dataclasses.replace(QUICK, max_iterations=10, settle=0, rewiring=False)
    other = picture(panda, self_model, camera, Q_GOAL + 0.2)
    key = jax.random.key(5)
    starts = np.stack([Q_START, Q_START + 0.05])
    batch = vrrt_jax.plan_batch(
        panda, open_world, self_model, camera, [image, other], starts, key=key, config=config
    )
    for i, goal in enumerate((image, other)):
        single = vrrt_jax.plan(
            panda,
            open_world,
            self_model,
            camera,
            goal,
            starts[i],
            key=jax.random.fold_in(key, i),
            config=config,
        )
        size = int(single.tree.size)
        assert int(batch[i].tree.size) == size
        assert batch[i].status is single.status
        # Sums of floats differ in order, and sign-like Adam steps amplify it: compare early nodes.
        np.testing.assert_allclose(batch[i].tree.q[:80], single.tree.q[:80], atol=1e-3)


def test_weighted_images_make_the_loss(panda, self_model, camera, image, rng):
    mask = rng.random(image.shape[:2]) < 0.8
    sight = Sight(panda, self_model, [camera, camera], [image, image], [mask, mask])
    policy, _ = visual_policy(sight, Q_START, QUICK)
    assert 0.5 < float(policy.goal.valid.mean()) < 0.9
    q = jnp.asarray(Q_START)
    args = (panda.chain, policy.splats, policy.cameras, policy.goal, q, policy.windows)
    apart = jax.jit(weighted_image)(*args) - weighted_goal(policy.goal)
    assert float(jnp.sum(apart**2)) == pytest.approx(float(goal_loss(*args)), rel=1e-4)


def test_a_mask_that_hides_the_robot_is_refused(panda, self_model, camera, image, open_world):
    hiding = image[..., 3] == 0
    with pytest.raises(ValueError, match="the masks leave nothing of the robot"):
        vrrt_jax.plan(
            panda,
            open_world,
            self_model,
            camera,
            image,
            Q_START,
            key=jax.random.key(0),
            mask=hiding,
        )


def test_holes_in_the_image_are_planned_around(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=3)
    mask = np.random.default_rng(0).random(image.shape[:2]) < 0.9
    mask[360:] = False  # the foot of the robot
    holed = np.where(mask[..., None], image, 1.0)
    key = jax.random.key(2)
    result = vrrt_jax.plan(
        panda, open_world, self_model, camera, holed, Q_START, key=key, config=QUICK, mask=mask
    )
    assert result.ok, str(result)
    assert np.abs(result.q_goal - Q_GOAL).max() < 0.05


def test_looks_lead_where_the_gradient_does(panda, self_model, camera, image, open_world):
    """Differences that are too long lose the weak directions, where steps are the longest."""
    sight = Sight(panda, self_model, camera, image)
    setup = visual_setup(sight, Q_START, planner.PlannerConfig(start_prior=0.0))
    assert setup.polishing is not None
    closer = setup.polishing.coarse
    noise = np.random.default_rng(0).normal(size=(LOOKS, 7))
    q = jnp.asarray(Q_GOAL + 0.03 * noise, jnp.float32)
    gradient = jax.jit(jax.vmap(jax.grad(closer.policy.loss, argnums=1), (None, 0)))(open_world, q)
    looks = jax.device_get(look_at(open_world, closer, q))
    matrix, slope = looks[3], looks[4]
    step = np.linalg.solve(matrix, slope[..., None])[..., 0]
    exact = np.linalg.solve(matrix, 0.5 * np.asarray(gradient)[..., None])[..., 0]
    np.testing.assert_allclose(step, exact, atol=0.1 * np.abs(exact).max())


def test_polishing_turns_the_wrist_back(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    sight = Sight(panda, self_model, camera, image)
    setup = visual_setup(sight, Q_START, planner.PlannerConfig(hypotheses=2))
    assert setup.polishing is not None
    polishing = setup.polishing
    turned = Q_GOAL + np.array([0.02, 0, -0.02, 0, 0.05, 0.05, 0.9], np.float32)
    q, loss, cost = polish(open_world, polishing, turned[None], 0)
    assert loss[0] < polishing.goal_loss and np.all(np.diff(cost) >= 0)
    assert np.abs(np.asarray(q[0]) - Q_GOAL).max() < 0.05
    inside_ball = vrrt_jax.move_obstacle(
        open_world, "ball", position=_hand_position(panda, Q_GOAL), size=(0.2, 0, 0)
    )
    cost = polish(inside_ball, polishing, turned[None], 0)[2]
    assert not np.isfinite(cost).any()  # what matches is in collision


def test_a_close_up_tells_half_a_turn(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=3)
    setup = visual_setup(Sight(panda, self_model, camera, image), Q_START, planner.PlannerConfig())
    polishing = setup.polishing
    assert polishing is not None and polishing.close_up is not None
    closer, goal_loss = _at_hand(open_world, polishing.fine, polishing.close_up, Q_GOAL)
    assert closer.policy.goal.rgb.shape[1:3] == (polishing.close_up.px,) * 2
    q = np.resize(np.stack([Q_GOAL, HALF_TURNED]), (LOOKS, 7))
    seen = [np.asarray(look_at(open_world, at, q)[1]) for at in (polishing.fine, closer)]
    fine, close = (loss[1] / loss[0] for loss in seen)
    assert close > fine > 1 and seen[1][0] < goal_loss


def _hand_position(panda, q):
    return np.asarray(vrrt_jax.link_poses(panda.chain, jnp.asarray(q)))[-1, :3, 3].tolist()


def finished(tree):
    return searches.SearchResult(
        tree=tree,
        stopped=searches.StopReason.REACHED,
        history=np.zeros((1, 4)),
        compile_s=0.0,
        search_s=0.0,
    )


def test_ambiguous_goals_are_told(panda, self_model, camera, open_world):
    """With a slack bar, the hand after half a turn matches too: both ends are named."""
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    config = planner.PlannerConfig(match_scale=20.0, polish_rounds=1)
    setup = visual_setup(Sight(panda, self_model, camera, image), Q_START, config)
    roots = jnp.asarray(np.stack([Q_START, Q_GOAL, HALF_TURNED]))
    score, payload = setup.policy.roots(open_world, roots)
    tree = trees.create(roots, score, payload, config.capacity)
    found = finished(tree)
    ends = (setup.goal_loss, setup.polishing, Q_START)
    result = finish.finish_visual(panda, open_world, found, *ends, jax.random.key(0), config)
    assert result.ok
    np.testing.assert_allclose(result.target, Q_GOAL, atol=0.02)
    assert len(result.alternatives) == 0  # an exact image tells them apart
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finish, "ALIKE", np.inf)
        result = finish.finish_visual(panda, open_world, found, *ends, jax.random.key(0), config)
    apart = np.abs(result.alternatives - HALF_TURNED).max(axis=1)
    assert len(apart) >= 1 and apart.min() < 0.3
    assert f"ambiguous: {len(apart)} other" in str(result)


SLIDER = """
<mujoco>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" range="-1 1"/>
      <geom type="box" size="0.1 0.1 0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def slider(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "slider.xml"
    path.write_text(SLIDER)
    return vrrt_jax.load_robot(path)


def beside(y):
    """A box that leaves ``y`` - 0.15 m to the slider that passes it."""
    return vrrt_jax.Obstacle(name="box", kind="box", position=(0, y, 0), size=(0.05, 0.05, 0.05))


@pytest.mark.parametrize("margin, granted", [(0.0, True), (0.001, False)])
def test_a_straight_way_that_only_the_spheres_refuse(slider, margin, granted):
    world = vrrt_jax.build_world(slider, [beside(0.1525)], margin=margin)
    ends = np.array([[-0.5], [0.5]], np.float32)
    steps = int(
        free_prefix(world, ends[:1], world.edge(jnp.asarray(ends[:1]), jnp.asarray(ends[1:])), 64)[
            0
        ]
    )
    assert 0 < steps < 64
    found = finished(trees.create(jnp.asarray(ends), jnp.zeros(2), None, 8))
    _, way = finish._straight(slider, world, found, *ends)
    assert (way is not None) == granted
    if granted:
        np.testing.assert_array_equal(way, ends)


def test_a_match_without_a_way_is_told(slider, monkeypatch):
    """What can be reached but does not match is no substitute for it."""
    world = vrrt_jax.build_world(slider, [beside(0.1)])
    q = np.array([[-0.4], [0.5]], np.float32)
    polished = (q, np.array([2.0, 0.5]), np.array([2.0, 0.5]))
    monkeypatch.setattr(finish, "_polished", lambda found, *_: (found, polished))
    found = finished(trees.create(jnp.asarray(q), jnp.ones(2), None, 8))
    config = planner.PlannerConfig(lanes=4, capacity=64, connect_iterations=5)
    polishing = types.SimpleNamespace(goal_loss=1.0)
    start = np.array([-0.5], np.float32)
    key = jax.random.key(0)
    args: tuple = (slider, world, found, 1.0, polishing, start, key, config)
    result = finish.finish_visual(*args)
    assert result.status is vrrt_jax.Status.NO_PATH and result.target == q[1]
    assert len(result.alternatives) == 0
    monkeypatch.setattr(finish, "_polished", lambda found, *_: (found, (q, *[np.ones(2)] * 2)))
    result = finish.finish_visual(*args)
    assert result.ok and result.target == q[0]


def test_another_attempt_while_nothing_matches(
    panda, self_model, camera, image, open_world, monkeypatch
):
    config = dataclasses.replace(QUICK, patience=1, match_scale=1e-6, hypotheses=0)
    args = (panda, open_world, self_model, camera, image, Q_START)
    results, begun = [], []
    for attempts in (1, 3):
        seen = []
        results.append(
            vrrt_jax.plan(
                *args,
                key=jax.random.key(0),
                config=dataclasses.replace(config, attempts=attempts),
                on_progress=lambda state, seconds: seen.append(int(state.tree.iteration)),  # noqa: B023
            )
        )
        begun.append(1 + int(np.sum(np.diff(seen) <= 0)))
    assert begun == [1, 3]
    assert all(r.status is vrrt_jax.Status.NO_MATCH for r in results)
    assert results[1].loss <= results[0].loss
    spent = finish.with_time_of(results[0], *results).timing["search_s"]
    assert spent == results[0].timing["search_s"] + results[1].timing["search_s"]

    ended = dataclasses.replace(results[1], status=vrrt_jax.Status.INTERRUPTED, loss=0.0)
    attempts = iter([results[0], ended])  # whose losses are of other images
    monkeypatch.setattr(planner, "_attempt", lambda *_: next(attempts))
    result = vrrt_jax.plan(*args, key=jax.random.key(0), config=config)
    assert result.status is vrrt_jax.Status.INTERRUPTED and result.loss == results[0].loss


def test_a_guess_becomes_a_root(panda, self_model, camera, image, open_world):
    config = dataclasses.replace(QUICK, probes=0, max_iterations=3, hypotheses=0)
    args = (panda, open_world, self_model, camera, image, Q_START)
    told = vrrt_jax.plan(*args, key=jax.random.key(0), config=config, q_guess=Q_GOAL + 0.05)
    np.testing.assert_allclose(told.tree.q[1], Q_GOAL + 0.05, atol=1e-6)
    assert told.loss < vrrt_jax.plan(*args, key=jax.random.key(0), config=config).loss
    with pytest.raises(ValueError, match="the guess is outside the limits: joint 'joint4'"):
        vrrt_jax.plan(*args, key=jax.random.key(0), config=config, q_guess=np.zeros(7) + 1)


def test_several_views_and_masks(panda, self_model, camera, image, open_world):
    second = vrrt_jax.look_at((-0.4, 1.9, 0.9), (0.1, 0.0, 0.4), height=480, width=480)
    images = [image, picture(panda, self_model, second, Q_GOAL)]
    sight = Sight(panda, self_model, [camera, second], images)
    visual, _ = visual_policy(sight, Q_START, QUICK)
    assert visual.goal.rgb.shape[0] == 2
    at_goal, at_start = (
        float(goal_loss(panda.chain, visual.splats, visual.cameras, visual.goal, jnp.asarray(q)))
        for q in (Q_GOAL, Q_START)
    )
    assert at_goal < 0.1 * at_start


TURNTABLE = """<mujoco><worldbody><body name="arm"><joint name="turn" axis="0 0 1" limited="false"/>
<geom type="sphere" size="0.05" pos="0.3 0 0"/></body></worldbody></mujoco>"""


def test_paths_go_on_where_a_joint_wraps(tmp_path, panda):
    (tmp_path / "turntable.xml").write_text(TURNTABLE)
    robot = vrrt_jax.load_robot(tmp_path / "turntable.xml")
    world = vrrt_jax.build_world(robot, [])
    q_start, q_goal = np.array([3.0 + 2 * np.pi]), np.array([-3.0])
    result = vrrt_jax.plan_to_configuration(robot, world, q_start, q_goal, key=jax.random.key(0))
    assert result.ok
    assert result.path[0] == pytest.approx(3.0, abs=1e-5)
    assert result.path[-1] == pytest.approx(2 * np.pi - 3.0, abs=1e-5)
    with pytest.raises(ValueError, match="the world is of a robot with joints turn; this one"):
        vrrt_jax.plan_to_configuration(panda, world, Q_START, Q_GOAL, key=jax.random.key(0))


def test_joint_goals(panda, wall_world):
    goal = Q_START * np.array([-1, 1, 1, 1, 1, 1, 1], np.float32)
    result = vrrt_jax.plan_to_configuration(panda, wall_world, Q_START, goal, key=jax.random.key(0))
    assert result.ok
    np.testing.assert_allclose(result.path[[0, -1]], [Q_START, goal], atol=1e-5)
    with pytest.raises(ValueError, match="unknown planner 'prm'; have: rrt, rrt-star"):
        vrrt_jax.plan_to_configuration(
            panda, wall_world, Q_START, goal, key=jax.random.key(0), planner="prm"
        )
