"""Maps that are too large for the memory are refused before they fail."""

from vrrt_jax.core import memory


def check_memory(needed: float, what: str) -> None:
    """See :func:`vrrt_jax.core.memory.check_memory`; the advice is to use a part of the map."""
    advice = "use a part of the map, as --crop x0,y0,x1,y1 or load_map(path, crop=(x0, y0, x1, y1))"
    memory.check_memory(needed, what, f"{advice} [m]")
