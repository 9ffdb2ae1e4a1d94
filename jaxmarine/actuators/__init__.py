"""Actuators beside the fixed thrusters: what their commands make of them, and what force that gives in the
flow.

Each kind is one file: its table in the vehicle file, its numbers, its two halves. A further kind is a class
that `load_vehicle(..., kinds=(*KINDS, Yours))` is told of.
"""

from ._base import AbstractActuators as AbstractActuators
from ._base import AbstractHull as AbstractHull
from ._base import AbstractKind as AbstractKind
from ._base import AbstractMasses as AbstractMasses
from ._base import Flow as Flow
from ._base import Stream as Stream
from ._base import along as along
from ._base import at_point as at_point
from ._base import joined as joined
from ._base import servo as servo
from ._base import stacked as stacked
from ._cross_damping import CrossDamping as CrossDamping
from ._cross_flow import CrossFlow as CrossFlow
from ._hull_polynomial import HullPolynomial as HullPolynomial
from ._propeller import Propellers as Propellers
from ._slider import Slide as Slide
from ._slider import Slider as Slider
from ._supply import Supply as Supply
from ._surface import FREE as FREE
from ._surface import Surfaces as Surfaces
from ._surge_drag import SurgeDrag as SurgeDrag
from ._swivel import Swivels as Swivels
from ._wind import Wind as Wind

KINDS: tuple[type[AbstractKind], ...] = (
    Propellers,
    Surfaces,
    CrossFlow,
    CrossDamping,
    HullPolynomial,
    SurgeDrag,
    Wind,
    Slider,
)
