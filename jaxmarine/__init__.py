"""Identifies marine vehicles from measured logs by differentiable simulation.

    log file -> Log -> residual -> fit -> diagnose -> extend -> report
    vehicle file -> Vehicle -> simulate ^

Fits and diagnoses need double precision: call `jax.config.update("jax_enable_x64", True)` first.
"""

import lazy_loader

# The names are those of `__init__.pyi`. Each is imported when it is first used: a look at the command
# line's help, or at the version, does not wait for the compiler.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
