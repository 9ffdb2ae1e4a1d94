"""Fleets: many logs of many craft, on all cores of a machine or of many (extra `fleet`)."""

import lazy_loader

# The names are those of `__init__.pyi`. A worker begins with what it is told of a job, and needs the rest of
# the package when it does it.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
