"""Control with an identified model: paths, feedforward, feedback, and learning under way."""

from ._feedforward import feedforward as feedforward
from ._follow import (
    Feedback as Feedback,
)
from ._follow import (
    Run as Run,
)
from ._follow import (
    follow as follow,
)
from ._follow import (
    pole_placement as pole_placement,
)
from ._learner import (
    Learned as Learned,
)
from ._learner import (
    Learner as Learner,
)
from ._learner import (
    dissipates as dissipates,
)
from ._learner import (
    prediction_error as prediction_error,
)
from ._path import Path as Path
from ._path import Reference as Reference
from ._path import plan as plan
from ._path import spiral as spiral
