"""What the simulation gets wrong, why, and what it buys to mend it."""

from ._diagnose import diagnose as diagnose
from ._result import (
    Alternative as Alternative,
    Diagnosis as Diagnosis,
    Finding as Finding,
    Gain as Gain,
    Parameter as Parameter,
)
