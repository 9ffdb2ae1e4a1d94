"""What the simulation gets wrong, why, and what it buys to mend it."""

from .._progress import Estimate as Estimate
from ._amid import STEADY as STEADY
from ._amid import steady_of as steady_of
from ._criteria import Criteria as Criteria
from ._diagnose import diagnose as diagnose
from ._disturbed import known as known
from ._filed import Coefficient as Coefficient
from ._filed import base_coefficients as base_coefficients
from ._fine import parts_of as parts_of
from ._fine import strength as strength
from ._knots import in_phase as in_phase
from ._plan import Box as Box
from ._plan import Manoeuvre as Manoeuvre
from ._plan import plan as plan
from ._possible import of_a_craft as of_a_craft
from ._result import (
    BANDS as BANDS,
)
from ._result import (
    Alternative as Alternative,
)
from ._result import (
    BeforeAfter as BeforeAfter,
)
from ._result import (
    Diagnosis as Diagnosis,
)
from ._result import (
    Dropped as Dropped,
)
from ._result import (
    Excess as Excess,
)
from ._result import (
    Finding as Finding,
)
from ._result import (
    Gain as Gain,
)
from ._result import (
    LogGain as LogGain,
)
from ._result import (
    MissingWrench as MissingWrench,
)
from ._result import (
    Parameter as Parameter,
)
from ._result import (
    Predictions as Predictions,
)
from ._result import (
    Recalibrated as Recalibrated,
)
from ._result import (
    Unscored as Unscored,
)
from ._result import (
    Weighed as Weighed,
)
from ._saturated import Layout as Layout
from ._saturated import SaturatedPlant as SaturatedPlant
from ._saturated import saturate as saturate
from ._score import solve as solve
from ._worth import gain_of as gain_of
