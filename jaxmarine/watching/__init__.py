"""A craft that is watched while it is under way."""
