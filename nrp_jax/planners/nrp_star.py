"""NRP*: Informed RRT* with learned waypoints."""

from nrp_jax.planners.nrp import NeuralRRT
from vrrt_jax.core.planners.informed_rrt_star import InformedRRTStar
from vrrt_jax.core.types import pytree


@pytree
class NeuralRRTStar(NeuralRRT, InformedRRTStar):
    """NRP* (Lu, Ma, Hsu and Cai): the expansions of NRP, aimed at samples of the informed set.

    Waypoints and what lies beyond them are both rewired, and try the ancestors of their parents as
    shortcuts. It goes on to improve until its budget ends.
    """
