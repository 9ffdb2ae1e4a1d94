"""Which craft there are to fly: what moves them by hand, where they begin and how they are drawn."""

import dataclasses
from collections.abc import Mapping

from ..examples import DEMOS
from ..vehicle import Vehicle
from ..vehicle_io import load_vehicle, packaged_vehicle


@dataclasses.dataclass(frozen=True)
class Stick:
    """A direction in which an operator asks for motion, after the hand control unit of the thesis (fig. 5.4).

    - `more`, `less`: what it does when pushed and when pulled, in words, and the key for each.
    - `columns`: shares of each command's usual range at full stick.
    - `pad`: axis of a gamepad in the standard layout, and the sign by which it pushes.
    - `lever`: it stays where it is put; else it springs back.
    """

    more: tuple[str, str]
    less: tuple[str, str]
    columns: Mapping[str, float]
    pad: tuple[int, int]
    lever: bool = False


@dataclasses.dataclass(frozen=True)
class Craft:
    """A packaged craft in the pool.

    - `size` [m]: length, beam and height as drawn, about `middle` [m, body axes]: pictures, not data.
    - `depth` [m]: of the origin at the start; `push` [N]: what its actuators give together, about.
    """

    packaged: str
    size: tuple[float, float, float]
    middle: tuple[float, float, float]
    depth: float
    push: float
    sticks: tuple[Stick, ...]

    def vehicle(self) -> Vehicle:
        return load_vehicle(packaged_vehicle(self.packaged))


def _surge(columns: tuple[str, ...], lever: bool = True) -> Stick:
    return Stick(("ahead", "w"), ("astern", "s"), dict.fromkeys(columns, 1.0), (1, -1), lever)


def _turn(columns: Mapping[str, float]) -> Stick:
    return Stick(("to starboard", "d"), ("to port", "a"), columns, (2, 1))


# By the kind of craft, as `examples.DEMOS`, whose craft they are.
CRAFTS: Mapping[str, Craft] = {
    kind: Craft(DEMOS[kind].craft, size, middle, depth, push, sticks)
    for kind, size, middle, depth, push, sticks in (
        (
            "rov",
            (1.0, 0.8, 0.9),
            (0.0, 0.0, -0.4),
            2.0,
            240.0,
            (
                _surge(("star_h", "port_h"), lever=False),
                _turn({"port_h": 1.0, "star_h": -1.0}),
                Stick(("dive", "ArrowDown"), ("rise", "ArrowUp"), {"star_v": 1.0, "port_v": 1.0}, (3, 1)),
                Stick(
                    ("roll to starboard", "e"), ("roll to port", "q"), {"star_v": 1.0, "port_v": -1.0}, (0, 1)
                ),
            ),
        ),
        (
            "auv",
            (1.6, 0.19, 0.19),
            (0.0, 0.0, 0.0),
            5.0,
            10.0,
            (
                _surge(("propeller",)),
                _turn({"rudder_top": 1.0, "rudder_bottom": 1.0}),
                Stick(
                    ("nose down", "ArrowDown"),
                    ("nose up", "ArrowUp"),
                    {"plane_port": 1.0, "plane_star": 1.0},
                    (3, 1),
                ),
            ),
        ),
        (
            "ship",
            (7.0, 1.27, 0.8),
            (0.0, 0.0, 0.0),
            0.0,
            50.0,
            (_surge(("propeller",)), _turn({"rudder": 1.0})),
        ),
        (
            "boat",
            (5.0, 2.8, 1.2),
            (0.0, 0.0, -0.2),
            0.0,
            1000.0,
            (
                _surge(("fore", "aft")),
                _turn({"fore_angle": 1.0, "aft_angle": -1.0}),
                Stick(
                    ("sideways to starboard", "e"),
                    ("sideways to port", "q"),
                    {"fore_angle": 1.0, "aft_angle": 1.0},
                    (0, 1),
                ),
            ),
        ),
    )
}
