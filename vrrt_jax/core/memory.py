"""How much memory there is, so that what is too large is refused before it fails."""

import resource
from pathlib import Path

_SHARE = 0.8  # of the free memory that may be used
_GIB = 2**30


def check_memory(needed: float, what: str, advice: str) -> None:
    """Refuse what does not fit into the memory that is free.

    Args:
        needed: bytes.
        what: needs them, as the start of a sentence.
        advice: what to do.

    Raises:
        ValueError: there is too little; the message says what to do.
    """
    free = free_memory()
    if free is not None and needed > _SHARE * free:
        raise ValueError(
            f"{what} needs {needed / _GIB:.1f} GiB of memory, and {free / _GIB:.1f} are free: "
            f"{advice}"
        )


def free_memory() -> int | None:
    """Bytes that this process may still take; None where the system does not tell."""
    found = []
    # What the machine has left, and what the container may have.
    for line in _text("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            found.append(int(line.split()[1]) * 1024)
    group = Path("/sys/fs/cgroup")
    most, used = _text(group / "memory.max").strip(), _text(group / "memory.current").strip()
    if most.isdigit() and used.isdigit():
        found.append(int(most) - int(used))
    # The limit of this process's address space.
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    pages = _text("/proc/self/statm").split()
    if limit != resource.RLIM_INFINITY and pages:
        found.append(limit - int(pages[0]) * resource.getpagesize())
    return max(min(found), 0) if found else None


def _text(path: str | Path) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
