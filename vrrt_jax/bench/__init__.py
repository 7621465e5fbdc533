"""Benchmarks; ``vrrt bench NAME`` prints and saves their figures. Compile time is kept apart."""
