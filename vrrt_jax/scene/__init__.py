"""A robot among obstacles: what is free, and the independent check with C MuJoCo."""
