"""How samplers learn: data from an expert, networks, training."""
