"""``python -m nrp_jax`` is the command ``nrp``."""

from nrp_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
