"""The classical terms: frames, rigid body, added mass, Coriolis, restoring, damping, actuators."""

from ._actuators import UNLIMITED as UNLIMITED
from ._actuators import Asked as Asked
from ._actuators import Curve as Curve
from ._actuators import Drive as Drive
from ._actuators import Late as Late
from ._actuators import Thrust as Thrust
from ._actuators import delayed as delayed
from ._actuators import lagging as lagging
from ._actuators import step_lengths as step_lengths
from ._actuators import thrust as thrust
from ._body import Load as Load
from ._body import coriolis as coriolis
from ._body import rigid_body_matrix as rigid_body_matrix
from ._damping import damping as damping
from ._frames import (
    apply as apply,
)
from ._frames import (
    attitude_rate as attitude_rate,
)
from ._frames import (
    compose as compose,
)
from ._frames import (
    conjugate as conjugate,
)
from ._frames import (
    from_euler as from_euler,
)
from ._frames import (
    norm as norm,
)
from ._frames import (
    rotation as rotation,
)
from ._frames import (
    skew as skew,
)
from ._frames import (
    small_turn as small_turn,
)
from ._frames import (
    to_euler as to_euler,
)
from ._frames import (
    to_euler_matrix as to_euler_matrix,
)
from ._geometry import (
    AbstractSolid as AbstractSolid,
)
from ._geometry import (
    Assembly as Assembly,
)
from ._geometry import (
    Box as Box,
)
from ._geometry import (
    Cylinder as Cylinder,
)
from ._geometry import (
    Element as Element,
)
from ._geometry import (
    Sphere as Sphere,
)
from ._late import KIND as KIND
from ._late import LATE as LATE
from ._late import Earlier as Earlier
from ._late import late as late
