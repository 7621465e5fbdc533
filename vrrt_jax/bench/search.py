"""The visual search: what an iteration costs, and the packaged problems from start to end."""

import functools
import resource
from collections.abc import Callable

import jax
import numpy as np

from vrrt_jax.config import Budget, PlannerConfig
from vrrt_jax.core.edge_checks import free_prefix
from vrrt_jax.core.expand import expand
from vrrt_jax.core.search import make_termination, search
from vrrt_jax.core.timing import interleaved_ms
from vrrt_jax.planner import plan
from vrrt_jax.problems import Problem, load_problem, problem_names
from vrrt_jax.scene.world import pose_error
from vrrt_jax.visual.lineages import LineageRRT
from vrrt_jax.visual.problem import make_problem

STAGES = ("scatter", "jump", "descend")  # of the search


def run(repeats: int = 15, seeds: int = 3, engine: str = "mjx") -> dict:
    """The split of one iteration, and the outcome of every packaged problem for several seeds."""
    problems = {name: load_problem(name, engine=engine) for name in problem_names()}
    split = iteration_split(next(iter(problems.values())), repeats)
    outcomes = {name: _outcome(problem, seeds) for name, problem in problems.items()}
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {**split, "problems": outcomes, "peak_memory_mb": round(peak_mb)}


def iteration_split(problem: Problem, repeats: int = 15) -> dict:
    """Times of the parts of one iteration in each stage, each jitted by itself [ms]."""
    config = PlannerConfig()
    visual = make_problem(problem.robot, problem.goal, problem.q_start, config)
    policy, goal = LineageRRT.from_config(config, problem.world), visual.goal
    world, key = problem.world, jax.random.key(0)
    begins, functions, calls = [0, *np.asarray(policy.stages).tolist()], _parts(policy), {}
    for stage, begin, end in zip(STAGES, begins[:-1], begins[1:], strict=True):
        found = search(
            world,
            goal,
            policy,
            policy.init(world, goal, problem.q_start[None], config.tree.capacity),
            key=key,
            termination=make_termination(-1.0, max_iterations=(begin + end) // 2),
        )
        tree = found.tree
        proposals = jax.jit(policy.propose)(world, goal, tree, key)
        q = tree.q[proposals.parent]
        # The arrays are arguments, as in the search: a closure would make them constants.
        arguments = {
            "iteration": (world, goal, policy, tree, key),
            "evaluate": (world, goal, policy, q, proposals),
            "propose": (world, goal, policy, tree, key),
            "edges": (world, q, proposals.target),
        }
        for name, args in arguments.items():
            calls[f"{stage}_{name}"] = functools.partial(functions[name], *args)
    times = interleaved_ms(calls, repeats)
    return {
        "lanes": policy.lanes,
        "num_splats": goal.splats.num_splats,
        "image_px": list(goal.image.alpha.shape[1:]),
        "capacity": config.tree.capacity,
        **{f"{name}_ms": round(value, 2) for name, value in times.items()},
        "iteration_over_gradient": round(times["descend_iteration"] / times["descend_evaluate"], 3),
    }


def _parts(policy: LineageRRT) -> dict[str, Callable]:
    """The parts of an iteration, jitted."""
    parts: dict[str, Callable] = {
        "iteration": expand,
        "evaluate": lambda world, goal, policy, *rest: policy.evaluate(world, goal, *rest),
        "propose": lambda world, goal, policy, *rest: policy.propose(world, goal, *rest),
        "edges": lambda world, q, target: free_prefix(
            world, q, world.steer(q, target, policy.edge_steps), policy.edge_steps
        ),
    }
    return {name: jax.jit(function) for name, function in parts.items()}


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
            apart = pose_error(problem.world, result.q_goal, problem.true_goal)
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
