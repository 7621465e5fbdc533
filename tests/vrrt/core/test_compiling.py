"""Programs that compile together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vrrt_jax.core.compiling import compile_together, host_jit


def test_programs_are_compiled_once_for_a_kind():
    called = []
    warm_ups = [lambda: called.append("start"), lambda: called.append("end")]
    for _ in range(2):
        compile_together({"q": np.zeros((3, 11))}, *warm_ups)
    assert sorted(called) == ["end", "start"]
    compile_together({"q": np.zeros((4, 11))}, *warm_ups)
    assert len(called) == 4


@pytest.mark.parametrize("fails", [0, 1])
def test_what_fails_on_either_thread_is_told_and_tried_again(fails):
    def fail():
        raise ValueError("no program")

    kind, called = np.zeros((2, 13 + fails)), []
    warm_ups = [lambda: called.append(1)] * 2
    with pytest.raises(ValueError, match="no program"):
        compile_together(kind, *warm_ups[:fails], fail, *warm_ups[fails + 1 :])
    called.clear()
    compile_together(kind, *warm_ups)
    assert len(called) == 2


def test_a_program_of_the_host_gives_what_others_give():
    def function(q):
        return jnp.sum(jnp.sin(q)) * q

    q = jnp.linspace(0, 1, 7)
    np.testing.assert_allclose(host_jit(function)(q), jax.jit(function)(q), rtol=1e-6)
