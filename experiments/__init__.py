"""Case studies and blind tests, one folder each."""
