"""Programs that compile while others do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vrrt_jax.core.compiling import compile_beside, host_jit


def test_what_comes_after_is_compiled_once_for_a_kind():
    called = []
    kind = {"q": np.zeros((3, 11))}
    for _ in range(2):
        assert compile_beside(lambda: "tree", lambda: called.append(1), kind) == "tree"
    assert len(called) == 1
    compile_beside(lambda: None, lambda: called.append(1), {"q": np.zeros((4, 11))})
    assert len(called) == 2


@pytest.mark.parametrize("fails", ["run", "warm_up"])
def test_what_fails_on_either_thread_is_told_and_tried_again(fails):
    def fail():
        raise ValueError("no program")

    kind = np.zeros((2, 13 if fails == "run" else 17))
    both = {"run": lambda: None, "warm_up": lambda: None} | {fails: fail}
    with pytest.raises(ValueError, match="no program"):
        compile_beside(kind=kind, **both)
    called = []
    compile_beside(lambda: None, lambda: called.append(1), kind)
    assert called


def test_a_program_of_the_host_gives_what_others_give():
    def function(q):
        return jnp.sum(jnp.sin(q)) * q

    q = jnp.linspace(0, 1, 7)
    np.testing.assert_allclose(host_jit(function)(q), jax.jit(function)(q), rtol=1e-6)
