"""From a path to the robot: limits of motion, trajectories, files, simulated execution."""
