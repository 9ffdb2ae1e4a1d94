"""Writes the report: everything or nothing."""

import json
import os
from pathlib import Path

from .._errors import InputError
from .._files import write_together
from ..diagnosis import Diagnosis
from ._page import page
from ._pictures import pictures


def write_report(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> Path:
    """Writes `index.html`, `diagnosis.json` and `figures/*.png` into `folder`; returns the page.

    Nothing is written unless everything could be made; a number that JSON does not have (NaN,
    infinity) in what `diagnosis.json` holds is a `ValueError`.
    """
    folder = Path(folder)
    files = {
        "index.html": page(diagnosis).encode("utf-8", errors="replace"),
        "diagnosis.json": _json(diagnosis).encode(),
    }
    files |= {f"figures/{name}": content for name, content in pictures(diagnosis).items()}
    try:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made a folder for the report; check the path.") from error
    write_together(folder, files)
    return folder / "index.html"


def _json(diagnosis: Diagnosis) -> str:
    return json.dumps(diagnosis.to_json(), allow_nan=False, indent=2) + "\n"
