"""Splat models of robots: pose, camera, rasterizer, loss and training."""
