"""Visual-RRT: goals that are images."""
