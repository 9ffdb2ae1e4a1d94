"""The command line, run in the process of the tests."""

import os
import sys
from pathlib import Path
from unittest import mock

from jaxmarine.cli import main


def exit_code(*words: str | Path) -> int:
    """Of a command line."""
    with mock.patch.object(sys, "argv", ["jaxmarine", *map(str, words)]), mock.patch.dict(os.environ):
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0
