"""Where the joints must be so that the tool is where it should be."""

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.tabletop.model import Model

_DAMPING, _LARGEST_TURN, _HOMING = 0.03, 0.25, 0.02


class ToolSolver:
    """Damped least squares on the arm's Jacobian, from wherever the joints were last.

    Source: Buss and Kim, "Selectively damped least squares for inverse kinematics" (2005), section 2: the plain damped
    form, with the pull towards the home pose in the null space.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._data = model.mujoco.MjData(model.model)
        self._home = np.asarray(model.arm.home)
        self._limits = model.model.jnt_range[model.model.dof_jntid[model.rates]].T

    def solve(
        self, joints: NDArray[np.float64], place: NDArray[np.float64], yaw: float, *, rounds: int = 2
    ) -> NDArray[np.float64]:
        """Joint angles [J] nearer to the tool at `place` [3], pointing down, its x axis at `yaw` radians."""
        wanted = _pointing_down(yaw)
        for _ in range(rounds):
            error, jacobian = self._seen_from(joints, place, wanted)
            square = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
            pull = _HOMING * (self._home - joints)
            move = pull + jacobian.T @ np.linalg.solve(square, error - jacobian @ pull)
            joints = np.clip(joints + np.clip(move, -_LARGEST_TURN, _LARGEST_TURN), *self._limits)
        return joints

    def _seen_from(
        self, joints: NDArray[np.float64], place: NDArray[np.float64], wanted: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What is missing in place and turn [6], and the Jacobian [6, J]."""
        m, model, data = self._model, self._model.model, self._data
        data.qpos[m.joints] = joints
        m.mujoco.mj_kinematics(model, data)
        m.mujoco.mj_comPos(model, data)
        jacobian = np.zeros((6, model.nv))
        m.mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], m.site)
        turned = data.site_xmat[m.site].reshape(3, 3)
        twist = 0.5 * np.cross(turned, wanted, axis=0).sum(1)
        return np.concatenate([place - data.site_xpos[m.site], twist]), jacobian[:, m.rates]


def _pointing_down(yaw: float) -> NDArray[np.float64]:
    """Axes of the tool as columns: x at `yaw` in the level, z down."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]])
