"""The water around a hull in MuJoCo, to stand beside its `vehicle.xml`; it knows nothing of jaxmarine.

    hull = Hull(folder, model)
    mujoco.set_mjcb_passive(hull)     # or call it in a callback of your own, once per vehicle

Commands are `data.ctrl`, by the actuators' names. The passive force is such that the hull accelerates as the
vehicle does with its added mass; MuJoCo knows the rigid body alone, and contacts and ties feel that.
"""

import json
from pathlib import Path

import casadi
import numpy as np

# Forward-left-up and north-west-up in MuJoCo, forward-starboard-down and north-east-down in the equations.
_FLIP = np.array([1.0, -1.0, -1.0])


class Hull:
    """The passive force on the body that the folder's `vehicle.xml` holds."""

    def __init__(self, folder, model):
        folder = Path(folder)
        told = json.loads((folder / "model.json").read_text(encoding="utf-8"))
        self._force = casadi.Function.deserialize((folder / "passive.casadi").read_text(encoding="utf-8"))
        joint = model.joint(told["joint"])
        self._pose, self._motion = joint.qposadr[0], joint.dofadr[0]
        self._body = model.jnt_bodyid[joint.id]
        self._controls = [model.actuator(name).id for name in told["command"]]

    def __call__(self, model, data):
        pose = data.qpos[self._pose : self._pose + 7]
        motion = data.qvel[self._motion : self._motion + 6]
        turn = data.xmat[self._body].reshape(3, 3)
        state = np.concatenate(
            [
                _FLIP * pose[:3],
                [pose[3], pose[4], -pose[5], -pose[6]],
                _FLIP * (turn.T @ motion[:3]),
                _FLIP * motion[3:],
            ]
        )
        wrench = self._force(state, data.ctrl[self._controls], data.time).full().ravel()
        # Of a free joint MuJoCo has forces in the world's axes and moments in the body's.
        data.qfrc_passive[self._motion : self._motion + 3] += turn @ (_FLIP * wrench[:3])
        data.qfrc_passive[self._motion + 3 : self._motion + 6] += _FLIP * wrench[3:]
