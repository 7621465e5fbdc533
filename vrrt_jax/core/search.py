"""The loop around the kernel: jitted chunks on the device; clock and progress on the host."""

import dataclasses
import enum
import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edges import Space
from vrrt_jax.core.expand import expand
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.tree import joined, path_cost, with_capacity
from vrrt_jax.core.types import ExpansionPolicy, Tree, pytree

MAX_CAPACITY = 1 << 20  # nodes that a tree may grow to
CHUNK = 8  # iterations between two checks of the clock
COST = 4  # column of a history: length of the best path


class StopReason(enum.IntEnum):
    """Why a search ended."""

    REACHED = 0  # a node's score is at or below the goal score
    CONVERGED = 1  # the best score no longer improves, or the policy has done all that it does
    ITERATIONS = 2
    TREE_FULL = 3
    TIME_LIMIT = 4
    INTERRUPTED = 5


@pytree
class Termination:
    """When a search ends, as traced numbers."""

    score: jax.Array  # () goal score
    # () i32 once there, go on until the best score has not improved for so long
    settle_iterations: jax.Array
    max_iterations: jax.Array  # () i32
    enough_iterations: jax.Array  # () i32 after so many the policy has done all that it does
    patience: jax.Array  # () i32 give up after so many iterations without improvement
    min_improvement: jax.Array  # () what counts as one: so much less ...
    min_ratio: jax.Array  # () ... or below this multiple of the score before


@pytree
class SearchState:
    """A tree on its way, with what the patience rule remembers."""

    tree: Tree
    reference_score: jax.Array  # ()
    reference_iteration: jax.Array  # () i32


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchResult:
    """A finished search."""

    tree: Tree
    stopped: StopReason  # of a batch, the last of them in the order above
    # (chunks + 1, 6): iteration, seconds, best score, nodes, length of the best path (inf before
    # the first) and configurations checked for collision, those of samplers included
    history: np.ndarray
    compile_s: float
    search_s: float
    lanes: int = 32  # expansions an iteration
    stopped_each: tuple[StopReason, ...] = ()  # of the problems of a batch
    advice: str = ""  # what failed and what to try next, where ``stopped`` does not tell


def make_termination(
    score: float,
    *,
    max_iterations: int,
    settle_iterations: int = 0,
    enough_iterations: int | None = None,
    patience: int | None = None,
    min_improvement: float = 0.0,
    min_ratio: float = 1.0,
) -> Termination:
    """A stopping rule; a search counts as converged by ``enough_iterations`` or ``patience``."""
    never = np.iinfo(np.int32).max
    numbers: dict[str, Any] = {
        "score": np.float32(score),
        "settle_iterations": np.int32(settle_iterations),
        "max_iterations": np.int32(max_iterations),
        "enough_iterations": np.int32(never if enough_iterations is None else enough_iterations),
        "patience": np.int32(never if patience is None else patience),
        "min_improvement": np.float32(min_improvement),
        "min_ratio": np.float32(min_ratio),
    }
    return Termination(**numbers)


def initial_state(tree: Tree) -> SearchState:
    """The state of a search that has not begun."""
    return SearchState(
        tree=tree, reference_score=jnp.min(tree.score), reference_iteration=tree.iteration
    )


_initial = host_jit(initial_state)
_initials = host_jit(jax.vmap(initial_state))


def stop_reason(state: SearchState, termination: Termination) -> jax.Array:
    """The :class:`StopReason` code () that holds, -1 while the search should go on."""
    tree = state.tree
    idle = tree.iteration - state.reference_iteration
    reached = (jnp.min(tree.score) <= termination.score) & (idle >= termination.settle_iterations)
    enough = tree.iteration >= termination.enough_iterations
    reasons = (
        (StopReason.REACHED, reached),
        (StopReason.CONVERGED, enough | (idle >= termination.patience)),
        (StopReason.ITERATIONS, tree.iteration >= termination.max_iterations),
        (StopReason.TREE_FULL, tree.size >= tree.capacity),
    )
    code = jnp.int32(-1)
    for reason, holds in reversed(reasons):
        code = jnp.where(holds, jnp.int32(reason), code)
    return code


def run_chunk(
    world: Space,
    goal: Any,
    policy: ExpansionPolicy,
    state: SearchState,
    termination: Termination,
    key: jax.Array,
    num_iterations: jax.Array,
) -> tuple[SearchState, jax.Array]:
    """Up to ``num_iterations`` iterations, and the rule that holds then: :func:`stop_reason`."""
    last = state.tree.iteration + num_iterations

    def goes_on(state: SearchState) -> jax.Array:
        return (state.tree.iteration < last) & (stop_reason(state, termination) < 0)

    def iterate(state: SearchState) -> SearchState:
        tree = expand(world, goal, policy, state.tree, key)
        best = jnp.min(tree.score)
        needed = state.reference_score * termination.min_ratio - termination.min_improvement
        improved = best < needed
        return SearchState(
            tree=tree,
            reference_score=jnp.where(improved, best, state.reference_score),
            reference_iteration=jnp.where(improved, tree.iteration, state.reference_iteration),
        )

    state = jax.lax.while_loop(goes_on, iterate, state)
    return state, stop_reason(state, termination)


_chunk = host_jit(run_chunk)
_run_chunks = jax.vmap(run_chunk, in_axes=(None, 0, None, 0, 0, 0, None))
_chunks = host_jit(_run_chunks)


@functools.lru_cache(maxsize=8)
def _chunks_over(mesh: Mesh) -> Callable:
    """``_chunks`` of a batch that is shared out to devices, of which none waits for another."""
    all_of_it, own = PartitionSpec(), PartitionSpec(mesh.axis_names[0])
    inputs = (all_of_it, own, all_of_it, own, own, own, all_of_it)
    # The types of a loop's numbers are the same on all devices, which JAX cannot see.
    return host_jit(
        jax.shard_map(_run_chunks, mesh=mesh, in_specs=inputs, out_specs=own, check_vma=False)
    )


def compile_search(
    world: Space,
    goal: Any,
    policy: ExpansionPolicy,
    tree: Tree,
    *,
    key: jax.Array,
    termination: Termination,
) -> None:
    """Compile what :func:`search` runs, by a search of no iterations."""
    _compile(partial(_chunk, world, goal, policy), _initial(tree), termination, key)


@single_precision
def search(
    world: Space,
    goal: Any,
    policy: ExpansionPolicy,
    tree: Tree,
    *,
    key: jax.Array,
    termination: Termination,
    time_limit_s: float = float("inf"),
    max_capacity: int = MAX_CAPACITY,
    batched: bool = False,
    mesh: Mesh | None = None,
    copies: int = 1,
    on_progress: Callable[[SearchState, float], Any] | None = None,
) -> SearchResult:
    """Grow a tree until a stopping rule holds, the time is up or the user interrupts.

    Args:
        world: robot and obstacles.
        goal: where to.
        policy: the planner.
        tree: the tree to start from.
        key: random key; the same key gives the same tree on the same machine, unless time ends it.
        termination: when to end.
        time_limit_s: wall time without compilation [s], looked at every few iterations.
        max_capacity: a full tree gets four times the room, up to so many nodes.
        batched: goal, tree, key and termination lead with an axis of Q problems; the search ends
            when all have.
        mesh: devices, along one axis, that share out a batch; they must divide Q.
        copies: trees that grow from the same roots at the same time, each on a thread and with a
            key of its own. They end together, when one has reached the goal or all are done, and
            become one tree. Not for batches.
        on_progress: called with the best copy's state and the seconds so far after every chunk.
    """
    roots = int(tree.size) if copies > 1 else 0
    states = [(_initials if batched else _initial)(tree)] * copies
    keys = list(jax.random.split(key, copies)) if copies > 1 else [key]
    run_chunks = _chunks if mesh is None else _chunks_over(mesh)
    advance = partial(run_chunks if batched else _chunk, world, goal, policy)
    compile_s = _compile(advance, states[0], termination, keys[0])
    history = [_record(policy, goal, states, 0.0)]

    def step(state: SearchState, key: jax.Array) -> tuple[SearchState, jax.Array]:
        return jax.block_until_ready(advance(state, termination, key, np.int32(CHUNK)))

    started = time.perf_counter()
    with interruptible() as interrupted, ThreadPoolExecutor(copies) as pool:
        run = pool.map if copies > 1 else map
        while True:
            states, codes = zip(*run(step, states, keys), strict=True)
            seconds = time.perf_counter() - started
            history.append(_record(policy, goal, states, seconds))
            if on_progress is not None:
                on_progress(_best_of(states), seconds)
            codes = np.concatenate([np.atleast_1d(code) for code in codes])
            if copies > 1 and np.any(codes == StopReason.REACHED):
                codes = np.full(copies, StopReason.REACHED)
            if interrupted.is_set():
                codes = np.where(codes != StopReason.REACHED, StopReason.INTERRUPTED, codes)
            elif seconds >= time_limit_s:
                unfinished = (codes < 0) | (codes == StopReason.TREE_FULL)
                codes = np.where(unfinished, StopReason.TIME_LIMIT, codes)
            capacity = states[0].tree.parent.shape[-1]
            if np.any(codes == StopReason.TREE_FULL) and capacity < max_capacity:
                # More room, and on; compiling for the new size is no time of the search.
                room = min(4 * capacity, max_capacity)
                states = [
                    dataclasses.replace(state, tree=with_capacity(state.tree, room))
                    for state in states
                ]
                again_s = _compile(advance, states[0], termination, keys[0])
                compile_s, started = compile_s + again_s, started + again_s
            elif np.min(codes) >= 0:
                break
    each = tuple(StopReason(code) for code in codes.tolist())
    grown = [state.tree for state in states]
    return SearchResult(
        tree=joined(grown, roots) if copies > 1 else grown[0],
        stopped=max(each),
        stopped_each=each,
        history=np.array(history),
        compile_s=compile_s,
        lanes=policy.lanes,
        search_s=time.perf_counter() - started,
    )


def no_search(policy: ExpansionPolicy, goal: Any, tree: Tree) -> SearchResult:
    """The search of a plan that has nothing to search for: it starts at its goal."""
    return SearchResult(
        tree=tree,
        stopped=StopReason.REACHED,
        stopped_each=(StopReason.REACHED,),
        history=np.array([_record(policy, goal, [_initial(tree)], 0.0)]),
        compile_s=0.0,
        lanes=policy.lanes,
        search_s=0.0,
    )


def _compile(
    advance: Callable, state: SearchState, termination: Termination, key: jax.Array
) -> float:
    """Compile the loop, if it has not been; seconds."""
    started = time.perf_counter()
    jax.block_until_ready(advance(state, termination, key, np.int32(0)))
    return time.perf_counter() - started


def _best_of(states: Sequence[SearchState]) -> SearchState:
    if len(states) == 1:
        return states[0]
    return min(states, key=lambda state: float(jnp.min(state.tree.score)))


def _record(
    policy: ExpansionPolicy, goal: Any, states: Sequence[SearchState], seconds: float
) -> tuple[float, ...]:
    """A row of the history; of a batch, the problem that is furthest from its goal."""
    rows = [jax.device_get(_summary(policy, goal, state.tree)) for state in states]
    iteration, best, nodes, cost, checked = np.array(rows, float).T
    return iteration.sum(), seconds, best.min(), nodes.sum(), cost.min(), checked.sum()


@jax.jit
def _summary(policy: ExpansionPolicy, goal: Any, tree: Tree) -> tuple[jax.Array, ...]:
    cost = getattr(policy, "path_cost", path_cost)
    if tree.iteration.ndim:
        cost = jax.vmap(cost)
    return (
        jnp.max(tree.iteration),
        jnp.max(jnp.min(tree.score, axis=-1)),
        jnp.max(tree.size),
        jnp.max(cost(tree, goal.threshold)),
        jnp.max(tree.checked),
    )
