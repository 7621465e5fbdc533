"""Results as files."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.files import replacing
from vrrt_jax.core.result import PlanResult
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.timing import versions
from vrrt_jax.core.tree_file import nodes_of, save_nodes
from vrrt_jax.problems import Problem, save_problem
from vrrt_jax.scene.world import World, pose_error


def summary(
    problem: Problem, result: PlanResult, config: PlannerConfig, seed: int
) -> dict[str, Any]:
    """All that there is to say about a plan, ready for JSON."""
    fields: dict[str, Any] = {
        "problem": problem.name,
        "robot": problem.robot.name,
        **outcome(problem.world, result),
        "seed": seed,
        "config": _plain(dataclasses.asdict(config)),
        "versions": versions(),
    }
    if problem.true_goal is not None:
        error = pose_error(problem.world, result.target, problem.true_goal)
        fields["error_rad"] = {"mean": float(error.mean()), "max": float(error.max())}
    return fields


def outcome(world: World, result: PlanResult) -> dict[str, Any]:
    """What the result itself says, ready for JSON."""
    check = result.verification
    return {
        "status": result.status.name,
        "advice": result.advice,
        "verified": bool(check is not None and check.ok),
        "verified_with": check.geometry if check is not None else None,
        "refused": result.refused,
        "contact": check.contact if check is not None else None,
        "clearance_m": _number(result.clearance),
        "loss": result.loss,
        "goal_loss": result.match_threshold,
        "colored_loss": result.colored_loss if np.isfinite(result.colored_loss) else None,
        "cost": result.cost,
        "raw_cost": path_length(world, result.raw_path),
        "q_goal": np.round(result.q_goal.astype(float), 6).tolist(),
        "target": np.round(result.target.astype(float), 6).tolist(),
        "alternatives": np.round(result.alternatives, 6).tolist(),
        "match_probability": _number(round(result.match_probability, 4)),
        "joint_uncertainty": None
        if result.joint_uncertainty is None
        else np.round(result.joint_uncertainty, 4).tolist(),
        "tree_share": round(result.tree_share, 4),
        "timing": {name: round(value, 4) for name, value in result.timing.items()},
        "counts": {
            "iterations": result.iterations,
            "nodes": int(result.tree.size),
            "waypoints": len(result.path),
            "rejected": dict(result.rejected),
        },
    }


def save_result(
    problem: Problem, result: PlanResult, config: PlannerConfig, seed: int, folder: Path
) -> None:
    """Write a plan's files into a folder, each at once or not at all.

    These are ``result.json``, ``path.npz``, ``tree.npz``, and the folder ``problem``: all that
    ``vrrt view`` shows.
    """
    arrays: dict[str, Any] = {
        "path": result.path,
        "raw_path": result.raw_path,
        "history": result.history,
        "joint_names": np.array(problem.robot.joint_names),
    }
    with replacing(folder / "path.npz") as file:
        np.savez_compressed(file, **arrays)
    save_nodes(nodes_of(result.tree), folder / "tree.npz")
    save_problem(problem, folder / "problem")
    with replacing(folder / "result.json", "w") as file:
        file.write(json.dumps(summary(problem, result, config, seed), indent=2) + "\n")


def _number(value: Any) -> Any:
    """NaN and infinity have no place in JSON."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by stage, ready for JSON."""
    return {
        name: _plain(value) if isinstance(value, dict) else _number(value)
        for name, value in settings.items()
    }
