"""The loop around the kernel: jitted chunks on the device; clock, progress, Ctrl-C on the host."""

import contextlib
import dataclasses
import enum
import signal
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edges import Space
from vrrt_jax.core.expand import expand
from vrrt_jax.core.types import ExpansionPolicy, Tree, pytree

CHUNK = 8  # iterations between two looks at the clock


class StopReason(enum.IntEnum):
    """Why a search ended."""

    REACHED = 0  # a node's score is at or below the goal score
    CONVERGED = 1  # the best score no longer improves
    ITERATIONS = 2
    TREE_FULL = 3
    TIME_LIMIT = 4
    INTERRUPTED = 5


@pytree
class Termination:
    """When to stop, as traced numbers."""

    score: jax.Array  # () goal score
    settle: jax.Array  # () i32 once there, go on until the best score has not improved for so long
    max_iterations: jax.Array  # () i32
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
    history: np.ndarray  # (chunks + 1, 4): iteration, seconds, best score, nodes
    compile_s: float
    search_s: float
    stopped_each: tuple[StopReason, ...] = ()  # of the problems of a batch


def make_termination(
    score: float,
    *,
    max_iterations: int,
    settle: int = 0,
    patience: int | None = None,
    min_improvement: float = 0.0,
    min_ratio: float = 1.0,
) -> Termination:
    """A stopping rule; without ``patience`` the search never counts as converged."""
    return Termination(
        score=jnp.float32(score),
        settle=jnp.int32(settle),
        max_iterations=jnp.int32(max_iterations),
        patience=jnp.int32(patience if patience is not None else np.iinfo(np.int32).max),
        min_improvement=jnp.float32(min_improvement),
        min_ratio=jnp.float32(min_ratio),
    )


def initial_state(tree: Tree) -> SearchState:
    """The state of a search that has not begun."""
    return SearchState(
        tree=tree, reference_score=jnp.min(tree.score), reference_iteration=tree.iteration
    )


def stop_reason(state: SearchState, stop: Termination) -> jax.Array:
    """The :class:`StopReason` code () that holds, -1 while the search should go on."""
    tree = state.tree
    idle = tree.iteration - state.reference_iteration
    reasons = (
        (StopReason.REACHED, (jnp.min(tree.score) <= stop.score) & (idle >= stop.settle)),
        (StopReason.CONVERGED, idle >= stop.patience),
        (StopReason.ITERATIONS, tree.iteration >= stop.max_iterations),
        (StopReason.TREE_FULL, tree.size >= tree.capacity),
    )
    code = jnp.int32(-1)
    for reason, holds in reversed(reasons):
        code = jnp.where(holds, jnp.int32(reason), code)
    return code


def run_chunk(
    world: Space,
    policy: ExpansionPolicy,
    state: SearchState,
    stop: Termination,
    key: jax.Array,
    num_iterations: jax.Array,
) -> tuple[SearchState, jax.Array]:
    """Up to ``num_iterations`` iterations, and the rule that holds then: :func:`stop_reason`."""
    last = state.tree.iteration + num_iterations

    def goes_on(state: SearchState) -> jax.Array:
        return (state.tree.iteration < last) & (stop_reason(state, stop) < 0)

    def iterate(state: SearchState) -> SearchState:
        tree = expand(world, policy, state.tree, key)
        best = jnp.min(tree.score)
        bar = state.reference_score * stop.min_ratio - stop.min_improvement
        improved = best < bar
        return SearchState(
            tree=tree,
            reference_score=jnp.where(improved, best, state.reference_score),
            reference_iteration=jnp.where(improved, tree.iteration, state.reference_iteration),
        )

    state = jax.lax.while_loop(goes_on, iterate, state)
    return state, stop_reason(state, stop)


_chunk = jax.jit(run_chunk)
_chunks = jax.jit(jax.vmap(run_chunk, in_axes=(None, 0, 0, 0, 0, None)))


def search(
    world: Space,
    policy: ExpansionPolicy,
    tree: Tree,
    *,
    key: jax.Array,
    stop: Termination,
    time_limit_s: float = float("inf"),
    batched: bool = False,
    on_progress: Callable[[SearchState, float], Any] | None = None,
) -> SearchResult:
    """Grow a tree until a stopping rule holds, the time is up or the user interrupts.

    Args:
        world: robot and obstacles.
        policy: the planner.
        tree: the tree to start from.
        key: random key; the same key gives the same tree on the same machine, unless time stops it.
        stop: stopping rules.
        time_limit_s: wall time without compilation [s], looked at every few iterations.
        batched: policy, tree, key and stop lead with an axis of Q problems; ends when all have.
        on_progress: called with the state and the seconds so far after every chunk.
    """
    state = (jax.vmap(initial_state) if batched else initial_state)(tree)
    advance = partial(_chunks if batched else _chunk, world, policy)
    started = time.perf_counter()
    jax.block_until_ready(advance(state, stop, key, jnp.int32(0)))
    compile_s = time.perf_counter() - started

    history = [_record(state, 0.0)]
    started = time.perf_counter()
    with interruptible() as interrupted:
        while True:
            state, codes = jax.block_until_ready(advance(state, stop, key, jnp.int32(CHUNK)))
            seconds = time.perf_counter() - started
            history.append(_record(state, seconds))
            if on_progress is not None:
                on_progress(state, seconds)
            codes = np.atleast_1d(codes)
            if interrupted.is_set():
                codes = np.where(codes != StopReason.REACHED, StopReason.INTERRUPTED, codes)
            elif seconds >= time_limit_s:
                codes = np.where(codes < 0, StopReason.TIME_LIMIT, codes)
            if np.min(codes) >= 0:
                break
    each = tuple(StopReason(code) for code in codes.tolist())
    return SearchResult(
        tree=state.tree,
        stopped=max(each),
        stopped_each=each,
        history=np.array(history),
        compile_s=compile_s,
        search_s=time.perf_counter() - started,
    )


def _record(state: SearchState, seconds: float) -> tuple[float, float, float, float]:
    """A row of the history; of a batch, the problem that is furthest from its goal."""
    tree = jax.device_get(state.tree)
    best = tree.score.min(axis=-1).max()
    return float(np.max(tree.iteration)), seconds, float(best), float(np.max(tree.size))


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Raise KeyboardInterrupt at the end after a Ctrl-C, for what is no result if it ends early."""
    with interruptible() as interrupted:
        yield
    if interrupted.is_set():
        raise KeyboardInterrupt


_interrupted: list[threading.Event] = []  # of the outermost block that runs


@contextlib.contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Turn Ctrl-C into a flag, so that the best path so far survives it; a second one is fatal.

    Blocks inside each other share the flag.
    """
    if threading.current_thread() is not threading.main_thread():
        yield threading.Event()
        return
    if _interrupted:
        yield _interrupted[0]
        return
    event = threading.Event()

    def on_interrupt(signum, frame):
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    previous = signal.signal(signal.SIGINT, on_interrupt)
    _interrupted.append(event)
    try:
        yield event
    finally:
        _interrupted.clear()
        signal.signal(signal.SIGINT, previous)
