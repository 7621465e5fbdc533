"""Homes: occupancy grids, read from files or generated."""
