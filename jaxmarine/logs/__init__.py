"""Recordings: reading, checking, noise and a first guess of the motion."""

from ._clean import clean as clean
from ._columns import ColumnMap as ColumnMap
from ._columns import ColumnSource as ColumnSource
from ._columns import read_columns as read_columns
from ._craft import Craft as Craft
from ._kinematics import Kinematics as Kinematics
from ._kinematics import differentiate as differentiate
from ._kinematics import smooth as smooth
from ._log import Log as Log
from ._log import Reason as Reason
from ._log import Rejected as Rejected
from ._motion import Motion as Motion
from ._motion import smooth_motion as smooth_motion
from ._noise import doubtful_noise as doubtful_noise
from ._noise import estimate_noise as estimate_noise
from ._noise import resolution as resolution
from ._noise import sensor_noise as sensor_noise
from ._notes import Note as Note
from ._notes import merged as merged
from ._notes import moment as moment
from ._notes import together as together
from ._read import read_log as read_log
from ._read import write_log as write_log
from ._states import StateTrack as StateTrack
from ._states import reachable as reachable
from ._states import smooth_states as smooth_states
