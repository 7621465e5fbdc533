"""A trajectory on a simulated robot: how well it is tracked, and whether it touches anything."""

import copy
import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.interpolate import BPoly

from vrrt_jax.motion.trajectory import Trajectory
from vrrt_jax.robots.mesh_sources import inertial_spec, install_hint
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import verify_path
from vrrt_jax.scene.world import World

_STEP_S = 0.001  # of the simulation and of the controller
_FREQUENCY = 20.0  # at which the controller takes errors away, critically damped [rad/s]
_STRIDE = 10  # every so many steps the robot's configuration is kept


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tracking:
    """What a simulated robot made of a trajectory. Letters: ``T`` times, ``D`` joints."""

    mean_error: float  # over times and joints [rad] or [m]
    max_error: float  # the largest of any joint at any time [rad] or [m]
    contact: str | None  # what the robot touched first, such as "link5 touches box_2 at 37 % ..."
    torque_share: float  # largest torque asked for, in units of its limit; NaN without limits
    positions: np.ndarray  # (T, D) where the robot was, every 0.01 s [rad] or [m]

    @property
    def ok(self) -> bool:
        """Whether the robot touched nothing."""
        return self.contact is None


def execute_in_sim(
    robot: Robot,
    world: Sequence[Obstacle] | World,
    trajectory: Trajectory,
    *,
    mass_error: float = 0.0,
) -> Tracking:
    """Run a trajectory on the robot's true masses in MuJoCo, by computed torque at 1 kHz.

    The controller cancels the dynamics that it believes in, and takes errors away like a critically
    damped spring of 20 rad/s. Torques end at the robot's limits, where its file has some. Obstacles
    do not push the robot: the configurations that it came through are checked for contacts with
    :func:`vrrt_jax.verify_path`. What the robot holds has no mass here.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        world: the obstacles, and what the robot holds; or K primitives.
        trajectory: from :func:`vrrt_jax.time_parameterize`, of this robot.
        mass_error: by how much all true masses are larger than the controller believes, as a
            share, above -1.

    Raises:
        ValueError: the trajectory is of another robot, ``mass_error`` is out of range, or the
            robot's masses are not on this machine.
    """
    if trajectory.joint_names != robot.joint_names:
        raise ValueError(
            f"the trajectory is of joints {', '.join(trajectory.joint_names)}; expected those of "
            f"'{robot.name}': {', '.join(robot.joint_names)}"
        )
    if not -1 < mass_error < np.inf:
        raise ValueError(f"mass_error is {mass_error}; expected a share above -1, such as 0.1")
    believed = _model(robot)
    true = copy.copy(believed)
    true.body_mass[:] *= 1 + mass_error
    true.body_inertia[:] *= 1 + mass_error
    positions, errors, torque_share = _tracked(believed, true, trajectory)
    # Errors of a hair at a joint's limit are no contact.
    low = np.where(robot.is_continuous, -np.inf, robot.lower)
    high = np.where(robot.is_continuous, np.inf, robot.upper)
    check = verify_path(robot, world, np.clip(positions, low, high))
    return Tracking(
        mean_error=float(errors.mean()),
        max_error=float(errors.max()),
        contact=check.contact,
        torque_share=torque_share,
        positions=positions,
    )


def _model(robot: Robot) -> mujoco.MjModel:
    """The robot with its true masses, in free space.

    Raises:
        ValueError: they are not on this machine, or the file has no masses for a body.
    """
    spec = inertial_spec(robot)
    if spec is None:
        raise ValueError(
            f"the masses of robot '{robot.name}' are not on this machine: "
            f"{install_hint(robot.mesh_source)}"
        )
    spec.option.timestep = _STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Strong damping makes accelerations of steps other ones than those of instants.
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_INVDISCRETE
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(
            f"robot '{robot.name}' cannot be simulated: {error}; expected an <inertial> for each "
            "body that moves"
        ) from None


def _tracked(
    believed: mujoco.MjModel, true: mujoco.MjModel, trajectory: Trajectory
) -> tuple[np.ndarray, np.ndarray, float]:
    """Positions (T, D), errors (n, D) after each step, and the largest share of torque limits."""
    desired = _in_steps(trajectory)
    model_data, data = mujoco.MjData(believed), mujoco.MjData(true)
    data.qpos[:] = desired[0, 0]
    limited = true.jnt_actfrclimited.astype(bool)
    low = np.where(limited, true.jnt_actfrcrange[:, 0], -np.inf)
    high = np.where(limited, true.jnt_actfrcrange[:, 1], np.inf)
    positions, errors, share = [desired[0, 0]], [np.zeros(true.nv)], np.nan
    for step in range(desired.shape[1] - 1):
        q, v, a = desired[:, step]
        # The torque that the believed robot needs for the acceleration that takes errors away.
        model_data.qpos[:], model_data.qvel[:] = data.qpos, data.qvel
        pull = _FREQUENCY**2 * (q - data.qpos) + 2 * _FREQUENCY * (v - data.qvel)
        model_data.qacc[:] = a + pull
        mujoco.mj_inverse(believed, model_data)
        torque = model_data.qfrc_inverse
        if limited.any():
            share = np.fmax(share, (np.abs(torque) / high)[limited].max())
        data.qfrc_applied[:] = np.clip(torque, low, high)
        mujoco.mj_step(true, data)
        errors.append(np.abs(data.qpos - desired[0, step + 1]))
        if (step + 1) % _STRIDE == 0 or step + 2 == desired.shape[1]:
            positions.append(data.qpos.copy())
    return np.array(positions), np.array(errors), float(share)


def _in_steps(trajectory: Trajectory) -> np.ndarray:
    """Positions, velocities and accelerations (3, n, D) at each step of the simulation.

    Between points, quintic polynomials, as controllers of ROS do.
    """
    states = trajectory.positions, trajectory.velocities, trajectory.accelerations
    if len(trajectory.time) == 1:
        return np.stack(states)
    curve = BPoly.from_derivatives(trajectory.time, np.stack(states, axis=1))
    time = np.arange(0.0, trajectory.duration + _STEP_S, _STEP_S).clip(max=trajectory.duration)
    return np.stack([curve(time), curve.derivative()(time), curve.derivative(2)(time)])
