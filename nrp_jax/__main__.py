"""``python -m nrp_jax`` is the command ``nrp``."""

from nrp_jax.cli import main

raise SystemExit(main())
