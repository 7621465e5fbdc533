"""Visual-RRT in JAX: from a picture of the goal to a verified, collision-free path."""

__version__ = "0.1.0"
