"""A simulator of marine vehicles in plain NumPy, apart from the package, and its test cases."""
