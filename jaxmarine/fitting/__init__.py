"""From logs to parameters: windows, their linearisation, and the solvers on it."""

from ._linearise import (
    LOOSE as LOOSE,
    Problem as Problem,
    Statistics as Statistics,
    linearise as linearise,
    predict as predict,
)
from ._solver import (
    Refined as Refined,
    Task as Task,
    WindowGaussNewton as WindowGaussNewton,
    refine_windows as refine_windows,
)
from ._windows import Cut as Cut, Records as Records, Windows as Windows, cut as cut
