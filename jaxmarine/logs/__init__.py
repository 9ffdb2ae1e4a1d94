"""Recordings: reading, checking, noise and a first guess of the motion."""

import lazy_loader

# The names are those of `__init__.pyi`. A log in memory needs none of the packages that files need (extra
# `files`).
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
