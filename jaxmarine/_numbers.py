"""Numbers, units and lists as a reader expects them in a sentence."""

import math
from collections.abc import Sequence

from ._types import DOFS

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, without an exponent where it reads well."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    size = abs(value)
    if size != 0 and not 1e-4 <= size < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{_minus(mantissa)}·10{str(int(exponent)).translate(_RAISED)}"
    places = 0 if size == 0 else max(0, digits - 1 - math.floor(math.log10(size)))
    text = f"{value:.{places}f}"
    return _minus(text.rstrip("0").rstrip(".") if "." in text else text)


def plus_minus(value: float, std: float, unit: str = "") -> str:
    """A value with its standard error, to the digits that the error leaves."""
    suffix = f" {unit}" if unit else ""
    if not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return number(value) + suffix
    if max(abs(value), std) >= 1e6 or max(abs(value), std) < 1e-4:
        return f"{number(value)} ± {number(std, 2)}{suffix}"
    places = _places(std)
    return _minus(f"{value:.{places}f}") + f" ± {std:.{places}f}{suffix}"


def _places(std: float) -> int:
    """Decimals that show one digit of the error, two where it begins with 1."""
    exponent = math.floor(math.log10(std))
    return max(0, -exponent + (1 if std / 10**exponent < 2 else 0))


def interval(value: float, std: float) -> str:
    """The 95 % interval of a parameter."""
    if not math.isfinite(std):
        return "not determined"
    ends = value - 1.96 * std, value + 1.96 * std
    if std <= 0 or max(map(abs, ends)) < 1e-4 or max(map(abs, ends)) >= 1e6:
        return " to ".join(number(end) for end in ends)
    return " to ".join(_minus(f"{end:.{_places(std)}f}") for end in ends)


def percent(part: float) -> str:
    """A ratio as a percentage."""
    return f"{number(100 * part, 2)} %"


def _minus(text: str) -> str:
    return text.replace("-", "−")


def unit_on(unit: str, target: str | None) -> str:
    """The unit that holds on that degree of freedom, where `unit` names one for each kind."""
    options = unit.replace(" or ", ", ").split(", ")
    if unit == "1":
        return ""
    if len(options) == 1 or target is None:
        return unit
    turning = sum(dof in DOFS[3:] for dof in target.replace("<-", "+").split("+"))
    return options[min(turning, len(options) - 1)]


def joined(parts: Sequence[str], last: str = "and") -> str:
    """`a`, `a and b`, `a, b and c`."""
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} {last} {parts[-1]}"


def count(n: int, noun: str) -> str:
    """`1 log`, `3 logs`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def sentence(text: str) -> str:
    """With a capital first letter and a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?", ":")) else ".")
