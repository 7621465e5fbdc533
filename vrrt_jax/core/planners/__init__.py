"""Planners on the kernel, one a file; :data:`PLANNERS` lists those to a joint goal by name."""

from vrrt_jax.core.planners.bit_star import BITStar
from vrrt_jax.core.planners.informed_rrt_star import InformedRRTStar
from vrrt_jax.core.planners.rrt import RRT
from vrrt_jax.core.planners.rrt_connect import RRTConnect
from vrrt_jax.core.planners.rrt_star import RRTStar

PLANNERS = {"rrt": RRT, "rrt-star": RRTStar, "rrt-connect": RRTConnect}

__all__ = ["PLANNERS", "RRT", "BITStar", "InformedRRTStar", "RRTConnect", "RRTStar"]
