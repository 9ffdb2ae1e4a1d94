"""The classical terms: frames, rigid body, added mass, Coriolis, restoring, damping, actuators."""

from ._actuators import Drive as Drive, step_lengths as step_lengths, thrust as thrust
from ._body import Load as Load, coriolis as coriolis, rigid_body_matrix as rigid_body_matrix
from ._damping import damping as damping
from ._frames import (
    apply as apply,
    attitude_rate as attitude_rate,
    compose as compose,
    from_euler as from_euler,
    norm as norm,
    rotation as rotation,
    skew as skew,
    small_turn as small_turn,
    to_euler as to_euler,
    to_euler_matrix as to_euler_matrix,
)
