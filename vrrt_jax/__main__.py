"""``python -m vrrt_jax`` is the command ``vrrt``."""

from vrrt_jax.cli import main

raise SystemExit(main())
