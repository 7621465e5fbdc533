"""Batches that several devices share out: four that the processor stands in for."""

from scripts import output_of

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np
import vrrt_jax

devices = jax.devices()
assert len(devices) == 4
key = jax.random.key(0)
problem = vrrt_jax.load_problem("panda_posts", engine="closed_form")
robot, world, q = problem.robot, problem.world, problem.q_start

starts = np.stack([q] * 5)
turns = 0.1 * np.eye(len(q))[:1] * np.arange(1, 6)[:, None]
goals = [vrrt_jax.ConfigurationGoal(q=q + turn) for turn in turns]
one = vrrt_jax.plan_batch(robot, world, goals, starts, key=key)
four = vrrt_jax.plan_batch(robot, world, goals, starts, key=key, devices=devices)
for i, (single, shared) in enumerate(zip(one, four, strict=True)):
    assert single.ok and shared.ok
    assert shared.tree.q.devices() == {devices[i % 4]}, shared.tree.q.devices()
    np.testing.assert_array_equal(single.tree.q, shared.tree.q)
    np.testing.assert_array_equal(single.path, shared.path)
print("joint goals")


@vrrt_jax.pytree
class NearGoal(vrrt_jax.LeastSquaresGoal):  # known by its loss, and quick to compile
    q: jax.Array
    threshold: jax.Array

    def residual(self, world, q):
        return q - self.q


goals = [NearGoal(q=jnp.asarray(goal.q), threshold=jnp.float32(1e-4)) for goal in goals[:3]]
starts = np.stack([q, q + 0.01, q + 0.02])
config = vrrt_jax.PlannerConfig().changed({"budget.max_iterations": 3, "lineages.samples": 64})
run = {"key": key, "config": config}
one = vrrt_jax.plan_batch(robot, world, goals, starts, **run)
four = vrrt_jax.plan_batch(robot, world, goals, starts, devices=devices[:2], **run)
for single, shared in zip(one, four, strict=True):
    assert single.status is shared.status and single.tree.size == shared.tree.size
    np.testing.assert_allclose(single.tree.q[:80], shared.tree.q[:80], atol=1e-3)
print("goals known by their loss")
"""


def test_devices_share_out_a_batch():
    assert "known by their loss" in output_of(
        SCRIPT, XLA_FLAGS="--xla_force_host_platform_device_count=4"
    )
