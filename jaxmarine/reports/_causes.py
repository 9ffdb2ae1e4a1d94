"""Each cause in words: a short title, and one sentence with its numbers, as its effect has them.

All texts are plain; what stands between backticks is a name from a file. The page escapes both.
"""

from collections.abc import Sequence

from .._numbers import number, sentence
from ..diagnosis import Finding
from ..effects import CATALOGUE, AbstractEffect, listed, push
from ..logs import moment
from ..vehicle import Vehicle
from ._curves import CHANNEL_TITLES


def effect_of(
    label: str, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE
) -> type[AbstractEffect] | None:
    """The one of the catalogue that a label such as `thruster_gain:port` accuses."""
    return next((effect for effect in catalogue if effect.name == label.partition(":")[0]), None)


def title(label: str, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE) -> str:
    """What a label such as `thruster_gain:port` accuses, in a few words; `thruster_gain`: on any target."""
    name, _, target = label.partition(":")
    effect = effect_of(label, catalogue)
    if effect is not None:
        return effect.title(target or None)
    if name == "unknown" and target:
        return f"unknown {push(target)}"
    return name.replace("_", " ") + (f" in {target}" if target else "")


def signal(name: str) -> str:
    """A column of the log in words."""
    if name == "t":
        return "time `t`"
    words = CHANNEL_TITLES.get(name)
    return f"command of `{name}`" if words is None else f"{words.rpartition(' ')[0]} `{name}`"


def what(
    finding: Finding,
    vehicle: Vehicle,
    clock: float = 0.0,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
) -> str:
    """The finding in one sentence, with its numbers and since when it holds.

    - `clock`: what the clock of the log in which it begins shows at that log's start [s].
    - `catalogue`: the effects that were suspected.
    """
    effect = effect_of(finding.label, catalogue)
    if effect is not None:
        text = effect.said(finding, vehicle)
    elif finding.named:
        text = f"{title(finding.label, catalogue)} ({listed(finding)})"
    else:
        text = _unknown(finding)
    if finding.since is not None:
        text += f", since {moment(finding.since, clock)}"
        text += f" of `{finding.since_log}`" if finding.since_log else ""
    return sentence(text)


def _unknown(finding: Finding) -> str:
    text = f"a {push(finding.target or '')} acts on the vehicle that no known cause explains"
    if finding.excess is None:
        return text
    e = finding.excess
    return (
        f"{text}: {number(e.rms)} {e.unit} root mean square, at most {number(e.peak)} {e.unit}, from t = "
        f"{number(e.begin, 4)} to {number(e.end, 4)} s of `{e.log}`, {number(e.share, 2)} of the full thrust "
        f"in {e.strongest}"
    )
