"""Which program it is that answers."""

import hashlib
from pathlib import Path

from ._version import __version__


def program(package: Path = Path(__file__).parent) -> str:
    """The version, and 12 hex digits of the SHA-256 of the sources.

    - `package`: folder of the sources, which are taken in the order of their paths.
    """
    sources = sorted(package.rglob("*.py"), key=lambda path: path.relative_to(package).as_posix())
    whole = b"".join(path.read_bytes() for path in sources)
    return f"{__version__} {hashlib.sha256(whole).hexdigest()[:12]}"
