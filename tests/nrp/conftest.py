"""Memory for the files of this folder: each begins without the programs of the one before."""

import gc

import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def forget_compiled_programs():
    """Compiled programs stay in memory until they are dropped: files hardly share any."""
    yield
    jax.clear_caches()
    gc.collect()
