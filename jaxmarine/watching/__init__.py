"""A craft that is watched while it is under way: what is wrong, since when, as the evidence grows."""

import lazy_loader

# The names are those of `__init__.pyi`. A watch in memory needs none of what sources and the page need.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
