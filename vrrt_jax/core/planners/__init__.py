"""Planners on the kernel, one a file."""
