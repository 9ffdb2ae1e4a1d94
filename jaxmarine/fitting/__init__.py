"""From logs to parameters: windows, their linearisation, and the solvers on it."""

from ._affine import (
    Affine as Affine,
)
from ._check import (
    AxisCheck as AxisCheck,
)
from ._check import (
    Check as Check,
)
from ._check import (
    check as check,
)
from ._check import (
    coefficient_name as coefficient_name,
)
from ._check import (
    evaluated as evaluated,
)
from ._check import (
    percent as percent,
)
from ._check import (
    sparkline as sparkline,
)
from ._disturbance import Disturbance as Disturbance
from ._disturbance import by_plane as by_plane
from ._driven import driven as driven
from ._feedback import answers as answers
from ._filter import Likelihood as Likelihood
from ._filter import Line as Line
from ._filter import Message as Message
from ._filter import Path as Path
from ._filter import Windowed as Windowed
from ._filter import estimated as estimated
from ._filter import free_wrench as free_wrench
from ._filter import improbability as improbability
from ._filter import innovations as innovations
from ._filter import likeliest_of as likeliest_of
from ._filter import lines as lines
from ._filter import maximise as maximise
from ._filter import nothing_known as nothing_known
from ._filter import path_lines as path_lines
from ._filter import promise as promise
from ._filter import start_spread as start_spread
from ._filter import whitened as whitened
from ._filter import worth_a_step as worth_a_step
from ._fit import Fit as Fit
from ._fit import FitError as FitError
from ._fit import fit as fit
from ._free import PRIOR_KEYS as PRIOR_KEYS
from ._free import Select as Select
from ._gross import GrossError as GrossError
from ._gross import gross_errors as gross_errors
from ._gross import misconnected as misconnected
from ._kinematics import contradiction as contradiction
from ._kinematics import disagreement as disagreement
from ._least_squares import (
    LeastSquares as LeastSquares,
)
from ._least_squares import (
    LinearSolution as LinearSolution,
)
from ._least_squares import (
    least_squares as least_squares,
)
from ._least_squares import (
    solve_linear as solve_linear,
)
from ._levenberg_marquardt import Restarts as Restarts
from ._levenberg_marquardt import fit_samples as fit_samples
from ._levenberg_marquardt import levenberg_marquardt as levenberg_marquardt
from ._linearise import (
    Statistics as Statistics,
)
from ._linearise import (
    linearise as linearise,
)
from ._linearise import (
    screening as screening,
)
from ._logarithms import USUAL_MEMORY as USUAL_MEMORY
from ._logarithms import USUAL_SIZE as USUAL_SIZE
from ._logarithms import count_of as count_of
from ._logarithms import logarithms_of as logarithms_of
from ._logarithms import unlearned as unlearned
from ._logarithms import unusual as unusual
from ._noise import median_noise as median_noise
from ._noise import noise_of as noise_of
from ._noise import noises_of as noises_of
from ._noise import tell_missed as tell_missed
from ._noise import widened as widened
from ._review import reviewed as reviewed
from ._rollout import (
    Problem as Problem,
)
from ._rollout import (
    measured_channels as measured_channels,
)
from ._rollout import (
    predict as predict,
)
from ._rollout import (
    start_precision as start_precision,
)
from ._rollout import (
    true_velocity as true_velocity,
)
from ._rollout import (
    wrapped as wrapped,
)
from ._shares import AbstractShares as AbstractShares
from ._shares import Kept as Kept
from ._shares import Share as Share
from ._shares import Shares as Shares
from ._shares import refine_shares as refine_shares
from ._solver import (
    LEAST_DAMPING as LEAST_DAMPING,
)
from ._solver import (
    Refined as Refined,
)
from ._solver import (
    Task as Task,
)
from ._solver import (
    WindowGaussNewton as WindowGaussNewton,
)
from ._solver import (
    refine_windows as refine_windows,
)
from ._subnets import (
    NetworkIdentification as NetworkIdentification,
)
from ._subnets import (
    damping_matrices as damping_matrices,
)
from ._subnets import (
    damping_targets as damping_targets,
)
from ._subnets import (
    identify_by_networks as identify_by_networks,
)
from ._trajectory import FINEST as FINEST
from ._trajectory import Segments as Segments
from ._trajectory import segments as segments
from ._uncertainty import Combination as Combination
from ._uncertainty import Parameter as Parameter
from ._uncertainty import t_value as t_value
from ._weights import largest as largest
from ._weights import overdispersion as overdispersion
from ._weights import scaled as scaled
from ._weights import settled as settled
from ._wider import Wider as Wider
from ._wider import drifting as drifting
from ._wider import flowing as flowing
from ._wider import wider_by as wider_by
from ._wider import with_current as with_current
from ._wider import with_drift as with_drift
from ._wider import with_swell as with_swell
from ._wider import without_swell as without_swell
from ._windows import GAP as GAP
from ._windows import PITCH as PITCH
from ._windows import PLANE as PLANE
from ._windows import TURNS as TURNS
from ._windows import Before as Before
from ._windows import Cut as Cut
from ._windows import Records as Records
from ._windows import Room as Room
from ._windows import Trail as Trail
from ._windows import Windows as Windows
from ._windows import at_rest as at_rest
from ._windows import cut as cut
from ._windows import split as split
from ._windows import steep as steep
