"""A file that may not grow, as on a full disk: one line says so, and what was done is kept."""

import contextlib
import resource

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from nrp_jax.learning.checkpoint import Model, save_model
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.training_io import CheckpointStore, State
from vrrt_jax.core import command
from vrrt_jax.core.results_file import append_row, resume, resume_rows, write

HEADER = {"seed": 0}
LONG = {"text": "x" * 3000}


@contextlib.contextmanager
def files_of_at_most(size):
    """No file of this process grows beyond so many bytes meanwhile."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def told(raised):
    """The line of a command."""
    line = command.in_one_line(raised.value)
    assert "make room on that disk" in line and "\n" not in line
    return line


def test_rows_that_were_told_as_done_are_kept(tmp_path):
    file = tmp_path / "rows"
    resume_rows(file, HEADER)
    append_row(file, {"row": 1})
    with files_of_at_most(1000), pytest.raises(OSError) as raised:
        append_row(file, LONG)
    told(raised)
    assert file.stat().st_size == 1000  # a part of the last row
    assert resume_rows(file, HEADER) == [{"row": 1}]
    append_row(file, LONG)
    assert resume_rows(file, HEADER) == [{"row": 1}, LONG]
    assert list(tmp_path.iterdir()) == [file]


def test_results_are_replaced_or_kept(tmp_path):
    file = tmp_path / "results.json"
    resume(file, HEADER, dict(HEADER))
    with files_of_at_most(1000), pytest.raises(OSError) as raised:
        write(file, HEADER | LONG)
    assert "the same command goes on from there" in told(raised)
    assert resume(file, HEADER, {}) == HEADER and list(tmp_path.iterdir()) == [file]


def test_a_model_that_has_no_room_says_where(tmp_path):
    config = ModelConfig.default("snake", "discriminator")
    variables = {"params": {"kernel": np.random.default_rng(0).normal(size=4000)}}
    model = Model(config=config, variables=variables, info={})
    with files_of_at_most(1000), pytest.raises(OSError) as raised:
        save_model(model, tmp_path / "model.npz")
    assert str(tmp_path / "model.npz") in told(raised) and not list(tmp_path.iterdir())


def test_an_epoch_before_is_kept(tmp_path, capfd):
    variables = {"params": {"kernel": np.arange(40_000, dtype=np.float32)}}

    def state(step):
        optimizer = optax.adam(1e-3).init(variables["params"])
        return State(variables=variables, optimizer=optimizer, step=jnp.int32(step))

    store = CheckpointStore(tmp_path / "checkpoint")
    store.save(state(1), variables, [{"loss": 1.0}], last=True)
    with files_of_at_most(20_000), pytest.raises(OSError) as raised:
        store.save(state(2), variables, [{"loss": 1.0}, {"loss": 2.0}], last=True)
    assert "an epoch before is kept" in told(raised)
    assert "Traceback" not in capfd.readouterr().err
    found, _, history = CheckpointStore(tmp_path / "checkpoint").restore(state(0))
    assert int(jax.device_get(found.step)) == 1 and history == [{"loss": 1.0}]
