"""How a diagnosis compares with what was hidden."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from .catalogue import DAMP

TOLERANCE = 12.0  # s, by which a beginning may be missed


def kind(answer: Mapping[str, Any]) -> str:
    """What sort of case it is: null, single, pair, outside or misfit."""
    if "unknown" in answer:
        return "outside"
    if answer["options"].get("misfit"):
        return "misfit"
    return ("null", "single", "pair")[len(answer["findings"])]


def matches(finding: Mapping[str, Any], hidden: Mapping[str, Any]) -> bool:
    """Whether a finding, or a cause that it calls indistinguishable, is what was hidden or equal to it."""
    named = [finding, *(a for a in finding.get("alternatives", ()) if a["indistinguishable"])][:3]
    return any(
        one["effect"] == effect and target in (None, one["target"])
        for one in named
        for effect, target in hidden["accept"]
    )


def own_name(finding: Mapping[str, Any], hidden: Mapping[str, Any]) -> bool:
    """Whether a finding itself, whatever it cannot be told from, is what was hidden or equal to it."""
    return matches({**finding, "alternatives": ()}, hidden)


def first_judged(answer: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The finding that the first name is: in a wrong file, false coefficients of it stand aside."""
    hidden = answer.get("findings", ())
    for finding in diagnosis["findings"]:
        aside = kind(answer) == "misfit" and finding["effect"] in DAMP
        if not aside or any(matches(finding, h) for h in hidden):
            return finding
    return None


def grade(answer: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> dict[str, bool]:
    """`first`: the first name is right; `whole`: all that was hidden is named, and nothing else.

    A name is right where it, or a cause that it is said to be indistinguishable from, is what was hidden; one
    finding stands for one cause.

    Outside the catalogue `first` means that the cause is said to be unknown, on an axis that is
    concerned, and nothing is named; `whole` that no other axis is, and that a right signal is among those
    it is said to depend on (`signal` alone).

    Where nothing is hidden, what pushes the craft may be named (`also`) if the test log confirms it.
    """
    findings = diagnosis["findings"]
    unknown = {f["target"] for f in findings if f["effect"] == "unknown"}
    named = [f for f in findings if f["effect"] != "unknown"]
    if "unknown" in answer:
        first = bool(unknown & set(answer["unknown"])) and not named
        signal = bool(set(answer["depends_on"]) & set(diagnosis["residual_after"]["depends_on"]))
        return {
            "first": first,
            "signal": signal,
            "whole": first and signal and unknown <= set(answer["unknown"]),
        }
    hidden: Sequence[Mapping[str, Any]] = answer["findings"]
    if not hidden:
        nothing = diagnosis["verdict"] == "nothing_found" and not findings
        pushed = bool(findings) and {f["effect"] for f in findings} <= set(answer.get("also", ()))
        right = nothing or (pushed and (diagnosis["gain"]["ratio_ci95"] or (1.0, 1.0))[1] < 1.0)
        return {"first": right, "whole": right}
    right = [any(matches(f, h) for h in hidden) for f in findings]
    aside = [kind(answer) == "misfit" and f["effect"] in DAMP for f in findings]
    judged = [r for r, a in zip(right, aside, strict=True) if r or not a]
    all_found = any(
        all(matches(f, h) for f, h in zip(chosen, hidden, strict=True))
        for chosen in itertools.permutations(findings, len(hidden))
    )
    return {"first": bool(judged) and judged[0], "whole": all_found and all(judged)}


def parameter_errors(answer: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Each hidden parameter that was found under its own name: truth, value and standard error."""
    out = []
    for hidden in answer.get("findings", ()):
        effect, target = hidden["accept"][0]
        for finding in diagnosis["findings"]:
            if (finding["effect"], finding["target"]) != (effect, target):
                continue
            for name, true in hidden["parameters"].items():
                said = finding["parameters"].get(name)
                if said is not None:
                    out.append({"parameter": f"{effect}.{name}", "true": true, **said})
    return out


def timely(answer: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> bool | None:
    """Whether every beginning is found within 12 s; None where nothing began."""
    begun = [h for h in answer.get("findings", ()) if h["since"] is not None]
    if not begun:
        return None
    return all(
        any(
            matches(f, h) and f["since"] is not None and abs(f["since"] - h["since"]) <= TOLERANCE
            for f in diagnosis["findings"]
        )
        for h in begun
    )
