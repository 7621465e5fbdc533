"""A robot among obstacles: what is free, and the last word of C MuJoCo."""
