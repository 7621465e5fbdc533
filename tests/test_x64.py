"""Both packages where JAX is set to 64 bit: everything is computed in float32 all the same."""

from scripts import output_of

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np
import nrp_jax, vrrt_jax

assert jnp.zeros(1).dtype == jnp.float64
KEY = jax.random.key(0)
robot = vrrt_jax.load_robot("panda")
ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=(0, 0.9, 0.9), size=(0.1, 0, 0))
world = vrrt_jax.build_world(robot, [ball], engine="closed_form")
home = jnp.asarray(robot.home, jnp.float64)
result = vrrt_jax.plan_to_configuration(robot, world, home, home.at[0].add(0.4), key=KEY)
assert result.ok and result.path.dtype == np.float32 and result.tree.q.dtype == jnp.float32
assert jax.jit(world.is_free)(home) and jax.jit(vrrt_jax.is_free)(world, home)
clearance = jax.vmap(lambda q: vrrt_jax.obstacle_clearance(world, q))(home[None])
assert clearance.dtype == jnp.float32
both = vrrt_jax.plan_batch(
    robot,
    [world] * 2,
    [vrrt_jax.ConfigurationGoal(q=home.at[0].add(0.3))] * 2,
    jnp.stack([home] * 2),
    key=KEY,
)
assert all(result.ok for result in both)
goal = vrrt_jax.load_problem("panda_posts", engine="closed_form").goal.at(robot, 32)
assert goal.image.rgb.dtype == jnp.float32 and goal.loss(world, home).dtype == jnp.float32
loss_gradient = jax.jit(jax.grad(lambda q: goal.loss(world, q)))(home)
assert jnp.isfinite(loss_gradient).all() and jnp.any(loss_gradient != 0)
gradient = jax.grad(lambda q: jnp.sum(vrrt_jax.link_poses(robot.chain, q)))(home)
assert gradient.dtype == jnp.float64 and jnp.isfinite(gradient).all()

snake = nrp_jax.load_robot("snake")
floor = nrp_jax.Grid(occupied=np.zeros((60, 60), bool))
start = jnp.array([1.0, 1, 0.3, 0.2, 0, 0.1, 0, 0])
result = nrp_jax.plan(snake, floor, start, start + 0.5, key=KEY, capacity=2048)
assert result.ok
assert nrp_jax.batch_is_free(nrp_jax.build_world(snake, floor), start[None])[0]
assert jnp.zeros(1).dtype == jnp.float64  # what the user has set stays
print("all in float32")
"""


def test_64_bit_changes_nothing():
    assert "all in float32" in output_of(SCRIPT, JAX_ENABLE_X64="1")
