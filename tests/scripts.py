"""Scripts in processes of their own, for what is set before JAX starts."""

import os
import subprocess
import sys


def output_of(script, **environment):
    """What a script prints; it must end well, and warn of nothing."""
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", script],
        capture_output=True,
        text=True,
        env={
            **os.environ,
            "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
            "JAX_COMPILATION_CACHE_DIR": os.path.expanduser("~/.cache/vrrt_jax_tests"),
            **environment,
        },
        timeout=500,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
