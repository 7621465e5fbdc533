"""The visual search: what an iteration costs, and the packaged problems from start to end."""

import resource

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import Budget, PlannerConfig
from vrrt_jax.core.edges import free_prefix, joint_error
from vrrt_jax.core.expand import expand
from vrrt_jax.core.search import make_termination, search
from vrrt_jax.core.timing import interleaved_ms
from vrrt_jax.core.types import Expansion
from vrrt_jax.planner import plan
from vrrt_jax.problems import Problem, load_problem, problem_names
from vrrt_jax.visual.policy import VisualRRT
from vrrt_jax.visual.problem import make_problem
from vrrt_jax.visual.seeds import seeded_roots


def run(repeats: int = 15, seeds: int = 3, engine: str = "mjx") -> dict:
    """The split of one iteration, and the outcome of every packaged problem for several seeds."""
    problems = {name: load_problem(name, engine=engine) for name in problem_names()}
    split = iteration_split(next(iter(problems.values())), repeats)
    outcomes = {name: _outcome(problem, seeds) for name, problem in problems.items()}
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {**split, "problems": outcomes, "peak_memory_mb": round(peak_mb)}


def iteration_split(problem: Problem, repeats: int = 15) -> dict:
    """Times of the parts of one iteration on a grown tree, each jitted by itself [ms]."""
    config = PlannerConfig()
    visual = make_problem(problem.robot, problem.goal, problem.q_start, config)
    policy, goal = VisualRRT.from_config(config, problem.world), visual.goal
    world, key = problem.world, jax.random.key(0)
    roots = seeded_roots(world, visual.seeds, problem.q_start[None], key)
    found = search(
        world,
        goal,
        policy,
        policy.init(world, goal, roots, config.tree.capacity),
        key=key,
        termination=make_termination(-1.0, max_iterations=40),
        time_limit_s=60.0,
    )
    tree = found.tree
    proposals = jax.jit(policy.propose)(world, goal, tree, key)
    parents = tree.q[proposals.parent]
    size = tree.size - policy.lanes
    expansion = Expansion(
        q=tree.q[size + jnp.arange(policy.lanes)],
        node_index=(size + jnp.arange(policy.lanes)).astype(jnp.int32),
        accepted=jnp.ones(policy.lanes, bool),
        blocked=jnp.zeros(policy.lanes, bool),
    )
    # The arrays are arguments, as in the search: a closure would make them constants.
    parts = {
        "iteration": (expand, (world, goal, policy, tree, key)),
        "gradient": (lambda p, *rest: p.evaluate(*rest), (policy, world, goal, parents, proposals)),
        "propose": (lambda p, *rest: p.propose(*rest), (policy, world, goal, tree, key)),
        "edges": (
            lambda w, a, b: free_prefix(w, a, b, policy.edge_steps),
            (world, parents, proposals.target - parents),
        ),
        "rewire": (
            lambda p, *rest: p.after_insert(*rest),
            (policy, world, goal, tree, proposals, expansion),
        ),
    }
    compiled = {name: (jax.jit(function), args) for name, (function, args) in parts.items()}
    times = interleaved_ms(
        {name: lambda f=f, args=args: f(*args) for name, (f, args) in compiled.items()}, repeats
    )
    return {
        "lanes": policy.lanes,
        "num_splats": goal.splats.num_splats,
        "image_px": list(goal.image.alpha.shape[1:]),
        "capacity": config.tree.capacity,
        "tree_nodes": int(tree.size),
        **{f"{name}_ms": round(value, 2) for name, value in times.items()},
        "iteration_over_gradient": round(times["iteration"] / times["gradient"], 3),
        "ms_per_iteration_in_search": round(1e3 * found.search_s / max(int(tree.iteration), 1), 2),
        "compile_s": round(found.compile_s, 2),
    }


def _outcome(problem: Problem, seeds: int) -> dict:
    rows = []
    for seed in range(seeds):
        result = plan(
            problem.robot,
            problem.world,
            problem.goal,
            problem.q_start,
            key=jax.random.key(seed),
            config=PlannerConfig(budget=Budget(time_limit_s=60.0)),
        )
        error = np.nan
        if problem.true_goal is not None:
            apart = joint_error(problem.world, result.q_goal, problem.true_goal)
            error = float(apart.mean())
        rows.append((result.ok, result.timing["search_s"], error, result.cost, result.iterations))
    table = np.array(rows, float)
    return {
        "n": seeds,
        "solved": float(table[:, 0].mean()),
        "search_s": np.round(table[:, 1], 2).tolist(),
        "mean_error_rad": np.round(table[:, 2], 4).tolist(),
        "cost_rad": np.round(table[:, 3], 2).tolist(),
        "iterations": table[:, 4].astype(int).tolist(),
    }
