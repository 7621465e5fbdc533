"""A mobile robot in a home: what is free, how far it is, and the last word of C MuJoCo."""
