"""Planners for homes beside those of the kernel, one a file."""
