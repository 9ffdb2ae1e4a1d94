"""What decides an answer: a few numbers, each with its reason."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Criteria:
    """When a diagnosis says something. All else that it computes is a likelihood or a measurement.

    - `odds`: that a name, or an unknown dependence, needs against none, after it has paid for its parameters
      and for how many there were to choose from. 150 to 1 is "very strong" after Kass and Raftery (1995).
    - `apart`: odds below which two causes are not told apart, and at which what the model does not expect
      counts as no noise: "strong", after the same.
    - `file_error`: by what share coefficients of a vehicle file are commonly off, where its table `[prior]`
      does not say it.
    - `few`: more coefficients than these being off means a file that is a little wrong everywhere: three are
      the added mass and the damping of one axis.
    - `scatter`: how much more than noise of the stated size scores may scatter before more than noise is
      looked for: a variance over 20 windows is known to 30 %, and this is two of that.
    - `worth`: share of the error of predictions that something must save to be of use.
    - `sigmas`, `sigmas_of_most`: standard errors over windows by which an unknown dependence must help on
      windows that were left out: some two thousand sets of signals are tried, of which chance alone gives
      three to a few; but hardly to one that explains most of what is left.
    - `most`: share that is most of what is missing beyond the noise: such a dependence on measured velocities
      speaks for itself; and of what a free force on its axis saves: then windows need not be alike.
    - `more`: share of a saving by which one more signal must help.
    - `smallest`: share of the strongest missing force's saving that one on another axis must have: a strong
      one reaches others through the coupled mass.
    - `steerable`: share of the full thrust that a disturbance may take for seconds on end: a craft that is to
      be turned and stopped at will needs as much again as it holds against.
    """

    odds: float = 150.0
    apart: float = 20.0
    file_error: float = 0.1
    few: int = 2
    scatter: float = 1.6
    worth: float = 0.05
    sigmas: float = 4.0
    sigmas_of_most: float = 3.0
    most: float = 0.7
    more: float = 0.05
    smallest: float = 0.02
    steerable: float = 0.5

    @property
    def nats(self) -> float:
        """Logarithm of the odds that an answer needs."""
        return math.log(self.odds)

    @property
    def close(self) -> float:
        """Logarithm of the odds at which two causes are told apart."""
        return math.log(self.apart)


DEFAULT = Criteria()
