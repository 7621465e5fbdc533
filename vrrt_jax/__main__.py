"""``python -m vrrt_jax`` is the command ``vrrt``."""

from vrrt_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
