"""Learned terms inside the physics."""

from ._damping import MLPDamping as MLPDamping
from ._damping import mlp_damping as mlp_damping
from ._learned import (
    SIGNALS as SIGNALS,
)
from ._learned import (
    LearnedWrench as LearnedWrench,
)
from ._learned import (
    learned_wrench as learned_wrench,
)
from ._learned import (
    signals as signals,
)
from ._learned import (
    signals_known as signals_known,
)
from ._rbf import Growth as Growth
from ._rbf import RBFDamping as RBFDamping
from ._rbf import basis_of as basis_of
from ._rbf import grow as grow
from ._rbf import rbf_damping as rbf_damping
from ._seen import Seen as Seen
from ._subnets import DampingNetworks as DampingNetworks
from ._subnets import NetworkDamping as NetworkDamping
from ._subnets import Perceptron as Perceptron
from ._subnets import perceptron as perceptron
from ._term import LearnedTerm as LearnedTerm
from ._thrust import LearnedThrust as LearnedThrust
from ._thrust import learned_thrust as learned_thrust

# What a vehicle file may name with a file of arrays beside it.
LEARNED: tuple[type[LearnedTerm], ...] = (
    LearnedWrench,
    MLPDamping,
    RBFDamping,
    NetworkDamping,
    LearnedThrust,
)
