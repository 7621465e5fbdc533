"""The nodes of a search tree on the host, and as a small file."""

import dataclasses
from pathlib import Path

import numpy as np

from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.files import replacing
from vrrt_jax.core.types import Tree

_LARGEST = 1e9  # [rad] or [m] of a node


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Nodes:
    """What a tree grew, without its empty slots. Letters: ``N`` nodes, ``D`` joints."""

    q: np.ndarray  # (N, D) [rad] or [m]
    parent: np.ndarray  # (N,) int, index of the parent, -1 for a root
    score: np.ndarray  # (N,) lower is better

    def edges(self, most: int) -> np.ndarray:
        """Children (E,) int of at most so many edges, evenly over the order of growth."""
        child = np.flatnonzero(self.parent >= 0)
        every = np.linspace(0, len(child) - 1, min(most, len(child))).astype(int)
        return child[every]

    def best_edges(self, most: int) -> np.ndarray:
        """Children (E,) int of at most so many edges, those of the lowest scores, in order."""
        child = np.flatnonzero(self.parent >= 0)
        return np.sort(child[np.argsort(self.score[child], kind="stable")[:most]])


def nodes_of(tree: Tree) -> Nodes:
    """The nodes of a tree, on the host."""
    size = int(tree.size)
    return Nodes(**{name: np.asarray(getattr(tree, name))[:size] for name in _FIELDS})


def save_nodes(nodes: Nodes, path: Path) -> None:
    """Write a compressed ``.npz`` with the fields of :class:`Nodes`, at once or not at all."""
    with replacing(path) as file:
        np.savez_compressed(file, **{name: getattr(nodes, name) for name in _FIELDS})


def load_nodes(path: Path, num_joints: int) -> Nodes:
    """Read what :func:`save_nodes` wrote of a robot with so many joints.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, or holds something else.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no tree at '{path}'; plan again to write one")
    arrays = read_arrays(path, *_FIELDS)
    q, parent, score = (arrays[name] for name in _FIELDS)
    num = len(q) if q.ndim == 2 and q.shape[1] == num_joints else -1
    is_tree = q.dtype.kind == score.dtype.kind == "f" and parent.dtype.kind == "i"
    is_tree = is_tree and parent.shape == score.shape == (num,) and (np.abs(q) <= _LARGEST).all()
    if not is_tree or np.any((parent < -1) | (parent >= num)) or np.isnan(score).any():
        shapes = ", ".join(f"{name} {arrays[name].shape}" for name in _FIELDS)
        raise ValueError(
            f"'{path}' is no tree; expected q (N, {num_joints}), parent (N,) of its nodes and "
            f"score (N,), got {shapes}; plan again"
        )
    return Nodes(q=q, parent=parent, score=score)


_FIELDS = tuple(field.name for field in dataclasses.fields(Nodes))
