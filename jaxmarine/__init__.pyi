from . import control as control
from . import diagnosis as diagnosis
from . import effects as effects
from . import exports as exports
from . import fitting as fitting
from . import fleets as fleets
from . import guesses as guesses
from . import imports as imports
from . import logs as logs
from . import networks as networks
from . import physics as physics
from . import reports as reports
from . import simulation as simulation
from . import watching as watching
from ._errors import InputError as InputError
from ._start import keep_programs as keep_programs
from ._version import __version__ as __version__
from .allocation import allocate as allocate
from .diagnosis import Criteria as Criteria
from .diagnosis import Diagnosis as Diagnosis
from .diagnosis import Finding as Finding
from .diagnosis import diagnose as diagnose
from .disturbances import RandomWrench as RandomWrench
from .effects import CATALOGUE as CATALOGUE
from .exports import export as export
from .fitting import (
    Check as Check,
)
from .fitting import (
    Fit as Fit,
)
from .fitting import (
    FitError as FitError,
)
from .fitting import (
    NetworkIdentification as NetworkIdentification,
)
from .fitting import (
    check as check,
)
from .fitting import (
    fit as fit,
)
from .fitting import (
    identify_by_networks as identify_by_networks,
)
from .fitting import (
    least_squares as least_squares,
)
from .fitting import (
    levenberg_marquardt as levenberg_marquardt,
)
from .fleets import Fleet as Fleet
from .fleets import fleet as fleet
from .guesses import guess_vehicle as guess_vehicle
from .imports import import_vehicle as import_vehicle
from .logs import Log as Log
from .logs import read_columns as read_columns
from .logs import read_log as read_log
from .logs import write_log as write_log
from .reports import write_report as write_report
from .simulation import Trajectory as Trajectory
from .simulation import initial_state as initial_state
from .simulation import simulate as simulate
from .vehicle import (
    Placed as Placed,
)
from .vehicle import (
    State as State,
)
from .vehicle import (
    Vehicle as Vehicle,
)
from .vehicle import (
    forward_dynamics as forward_dynamics,
)
from .vehicle import (
    inverse_dynamics as inverse_dynamics,
)
from .vehicle_io import (
    load_vehicle as load_vehicle,
)
from .vehicle_io import (
    packaged_vehicle as packaged_vehicle,
)
from .vehicle_io import (
    save_vehicle as save_vehicle,
)
from .watching import Watch as Watch
