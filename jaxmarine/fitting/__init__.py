"""From logs to parameters: windows, their linearisation, and the solvers on it."""

from ._linearise import (
    Problem as Problem,
    Statistics as Statistics,
    linearise as linearise,
    predict as predict,
    start_precision as start_precision,
)
from ._solver import (
    Refined as Refined,
    Task as Task,
    WindowGaussNewton as WindowGaussNewton,
    refine_windows as refine_windows,
)
from ._windows import Cut as Cut, Records as Records, Windows as Windows, cut as cut
from ._fit import Fit as Fit, FitError as FitError, fit as fit, noise_of as noise_of
from ._least_squares import (
    LeastSquares as LeastSquares,
    LinearSolution as LinearSolution,
    least_squares as least_squares,
    solve_linear as solve_linear,
)
from ._levenberg_marquardt import Restarts as Restarts, levenberg_marquardt as levenberg_marquardt
from ._uncertainty import Combination as Combination, Parameter as Parameter
