"""What a diagnosis says, in sentences for someone who has never seen the program.

All texts are plain; what stands between backticks is a name from a file. The page escapes both.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence

from .._numbers import count, joined, number, percent, sentence, unit_on
from ..diagnosis import Diagnosis, Finding
from ..effects import CATALOGUE, AbstractEffect
from ._causes import effect_of, signal, title, what

VERY_STRONG = 5.0  # log evidence, after Kass and Raftery (1995)


def advice(finding: Finding, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE) -> str:
    """What to look at on the boat; `catalogue`: the effects that were suspected."""
    if finding.excess is not None:
        e = finding.excess
        begin, end = (number(t - e.log_begin, 4) for t in (e.begin, e.end))
        return (
            f"See what happened from {begin} to {end} s after the start of `{e.log}`: commands that were not "
            "acted on (another hand at the sticks, power or link lost), a line, the bottom or another craft, "
            "or sensors that were wrong. The extended vehicle lacks it: diagnose the log without that part."
        )
    if not finding.named:
        look = (
            f"Look for what changes with the {joined([signal(name) for name in finding.signals])}."
            if finding.signals
            else "The residual names no signal; look at the missing wrench over time below."
        )
        if not finding.learned:
            return f"{look} It was not learned, so the extended vehicle lacks it too."
        return (
            f"{look} Until its cause is known, the extended vehicle carries a term learned from "
            "the log: good for prediction, no explanation."
        )
    effect = effect_of(finding.label, catalogue)
    return sentence(effect.advice) if effect is not None and effect.advice else ""


def sureness(log_evidence: float, of: str = "", doubted: bool = False) -> str:
    """The log evidence in words and as a number (Kass and Raftery, 1995).

    - `of`: what is that sure; `doubted`: whether more cannot be called than positive (`Diagnosis.doubted`).
    """
    if not math.isfinite(log_evidence):
        return "The evidence could not be put into a number."
    if log_evidence < 0:
        words = "None: the log speaks against it"
    elif log_evidence < 1:
        words = "Hardly worth a mention"
    elif log_evidence < 3 or doubted:
        words = "Positive, no more"
    elif log_evidence < VERY_STRONG:
        words = "Strong"
    else:
        words = "Very strong"
    words = f"{of}: {words[0].lower()}{words[1:]}" if of else words
    return f"{words} (log evidence {number(log_evidence)}; more than 5 is very strong)."


def rivals(finding: Finding, groups: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """The labels of what the log cannot tell from the finding."""
    found = [other.label for other in finding.alternatives if other.indistinguishable]
    for group in groups:
        if finding.label in group:
            found += [label for label in group if label != finding.label]
    return tuple(dict.fromkeys(found))


def deciding(labels: Sequence[str], catalogue: Sequence[type[AbstractEffect]] = CATALOGUE) -> str:
    """Which manoeuvre shows which of these causes best; `catalogue` as in `advice`."""
    manoeuvres = dict[str, list[str]]()
    for label in labels:
        effect = effect_of(label, catalogue)
        if effect is not None and effect.shown_by:
            manoeuvres.setdefault(effect.shown_by, []).append(title(label, catalogue))
    if len(manoeuvres) == 1:
        return sentence(f"a log with {next(iter(manoeuvres))}")
    parts = [f"{manoeuvre} (shows {joined(names)})" for manoeuvre, names in manoeuvres.items()]
    return sentence(f"a log with {'; with '.join(parts)}") if parts else ""


def next_best(finding: Finding, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE) -> str:
    """The strongest cause that the log could tell from the finding."""
    told_apart = [other for other in finding.alternatives if not other.indistinguishable]
    if not told_apart:
        return ""
    best = max(told_apart, key=lambda other: other.log_evidence)
    return (
        f"The next best, {title(best.label, catalogue)}, has a log evidence of {number(best.log_evidence)}."
    )


def values(
    label: str, parameters: Mapping[str, float], catalogue: Sequence[type[AbstractEffect]] = CATALOGUE
) -> str:
    """`factor 0.71`: the numbers of a suspect with their units; `catalogue` as in `advice`."""
    effect, target = effect_of(label, catalogue), label.partition(":")[2]
    units = {} if effect is None else effect.units
    return ", ".join(
        f"{key} {number(value)} {unit_on(units.get(key, ''), target or None)}".rstrip()
        for key, value in parameters.items()
    )


def verdict(diagnosis: Diagnosis) -> str:
    """The whole answer in one sentence."""
    named = [finding for finding in diagnosis.findings if finding.named]
    strange = [finding.target or "" for finding in diagnosis.findings if not finding.named]
    unknown = (
        f"something that no known cause explains acts in {joined(strange)}"
        if strange
        else ("something that no known cause explains is left")
    )
    if diagnosis.verdict == "nothing_found" and diagnosis.recalibrated:
        refitted = count(len(diagnosis.recalibrated), "refitted coefficient")
        return f"No single cause is to blame: the extended vehicle has {refitted} of the file."
    if diagnosis.verdict == "nothing_found" and diagnosis.far:
        return (
            "The vehicle file does not explain these logs, and no cause was found. Check the axes, signs and "
            "units of both; a strong disturbance would look like this too."
        )
    if diagnosis.verdict == "nothing_found" and diagnosis.dropped:
        return "No cause is named: what was found at first did not hold."
    if diagnosis.verdict == "nothing_found" and diagnosis.missed:
        return "No cause was found, but the vehicle file misses the sensors by far more than their noise."
    if diagnosis.verdict == "nothing_found":
        return "Nothing is wrong that these logs could show: the vehicle file explains them."
    if diagnosis.verdict == "unexplained":
        return sentence(unknown)
    if diagnosis.verdict == "explained" and len(named) == 1 and not diagnosis.far:
        found, clock = _without_errors(named[0]), diagnosis.clock_of(named[0])
        return what(found, diagnosis.vehicle, clock, diagnosis.catalogue)
    causes = joined([title(finding.label, diagnosis.catalogue) for finding in named])
    if diagnosis.verdict == "explained" and diagnosis.far:
        return (
            f"What explains these logs best leaves much: {causes}. Check the axes, signs and units of logs "
            "and file before you believe it."
        )
    if diagnosis.verdict == "explained":
        return f"{len(named)} causes explain these logs: {causes}."
    verb = "explains" if len(named) == 1 else "explain"
    return sentence(f"{causes} {verb} a part of what these logs show; {unknown}")


def _without_errors(finding: Finding) -> Finding:
    """For the title: numbers without standard errors have few digits; the finding below has all of them."""
    sizes = {name: dataclasses.replace(p, std=0.0) for name, p in finding.parameters.items()}
    return dataclasses.replace(finding, parameters=sizes)


def explanation(diagnosis: Diagnosis) -> str:
    """Below the verdict: how well the logs are explained now, and what is left."""
    before, after = _times_noise(diagnosis.misfit_before), _times_noise(diagnosis.misfit_after)
    over = f"Over {count(len(diagnosis.train), 'training log')}"
    extended = diagnosis.verdict != "nothing_found" or bool(diagnosis.recalibrated)
    text = f"{over}, the vehicle file is off by {before}"
    if extended:
        text += f", the extended vehicle by {after}"
    if diagnosis.missed:
        text = (
            f"{over}, the {'extended vehicle' if extended else 'vehicle file'} misses the sensors by far "
            "more than their noise; the notes say by how much, and sensors are weighed by it"
        )
    contradicted = f" {diagnosis.contradicted}" if diagnosis.contradicted else ""
    return f"{text}. {remainder(diagnosis)}{contradicted}"


def yardstick(diagnosis: Diagnosis) -> str:
    """What errors are measured by."""
    return "what sensors are weighed by" if diagnosis.missed else "sensor noise"


def _times_noise(misfit: float) -> str:
    """A chi-square per sample as a size; a tenth above one is what chance and rounding leave."""
    if misfit < 1.1:
        return "no more than the sensor noise"
    return f"{number(math.sqrt(misfit), 2)} times the sensor noise"


def remainder(diagnosis: Diagnosis) -> str:
    """What is left after the named findings."""
    if diagnosis.white:
        return "What is left is sensor noise."
    if diagnosis.depends_on:
        names = joined([signal(name) for name in diagnosis.depends_on])
        return f"What is left is more than noise, and it depends on the {names}."
    large = [finding.target or "" for finding in diagnosis.findings if finding.excess is not None]
    if large:
        return f"What is left in {joined(large)} is larger than any plausible disturbance."
    return (
        "What is left is more than sensor noise, and of no logged signal is it certain that it goes with it: "
        "a disturbance, such as waves or gusts, or a cause that these logs are too short to show."
    )


def gain_words(diagnosis: Diagnosis) -> str:
    """What the extension buys, in one sentence."""
    gain = diagnosis.gain
    if diagnosis.verdict == "nothing_found" and diagnosis.recalibrated:
        return "No cause was added, so there is no gain to state; refitted coefficients alone count as none."
    if diagnosis.verdict == "nothing_found":
        return "Nothing was added to the model, so its predictions stay what they were."
    text = (
        f"Predictions over {number(gain.horizon)} s now have {percent(gain.ratio)} of the error that they "
        f"had ({interval(gain.ratio_ci95)}), over all measured channels, each in units of its noise."
    )
    return f"{text} That is not so for {joined(list(gain.worse))}." if gain.worse else text


def interval(ends: tuple[float, float] | None) -> str:
    """The 95 % interval of a ratio, or why there is none."""
    if ends is None:
        return "too short a log for an interval"
    return "95 % interval {} to {}".format(*map(percent, ends))


def held_out(diagnosis: Diagnosis) -> str:
    """Whether the gain was measured on a log that the diagnosis had not seen."""
    names = joined([f"`{name}`" for name in diagnosis.tests])
    if diagnosis.gain.held_out and len(diagnosis.tests) == 1:
        return (
            f"Held out: {names} was not used for finding or fitting anything; it could at most take names "
            "back that buy nothing on it."
        )
    if diagnosis.gain.held_out:
        return (
            f"Held out: {names} were not used for finding or fitting anything; they could at most take names "
            "back that buy nothing on them."
        )
    seen = [f"`{one.name}`" for one in diagnosis.gain.per_log if not one.held_out]
    return (
        f"Not held out: {joined(seen) or names} {'were' if len(seen) > 1 else 'was'} also used for training, "
        "so the gain is too good to be true for a new log. Test on another one."
    )
