"""The pool: a craft to fly in the browser, with faults to switch on, recorded as a log (extra `report`)."""

from .._extras import of_extra

with of_extra("report", "The pool"):
    from ._crafts import CRAFTS as CRAFTS
    from ._pool import Pool as Pool
    from ._server import commands_of as commands_of
    from ._server import serve as serve
