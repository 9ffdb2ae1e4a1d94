"""Where logs lie: local paths, and URLs that fsspec knows (`s3://...`, `memory://...`)."""

import glob
import hashlib
import importlib
import os
from pathlib import Path
from typing import Any

from .._errors import InputError

_URL = "://"


def is_url(place: str) -> bool:
    return _URL in place


def store_of(url: str) -> tuple[Any, str]:
    """The file system that a URL is of, and the path in it."""
    try:
        return importlib.import_module("fsspec.core").url_to_fs(url)
    except ImportError as error:
        raise InputError(
            f"{url}: needs a library that is not installed ({error.name or error}); install it, or "
            "`pip install 'jaxmarine[fleet]'`."
        ) from error
    except ValueError as error:
        raise InputError(f"{url}: is of no kind that fsspec knows ({error}); check the URL.") from error


def found(pattern: str, folder: str) -> tuple[str, ...]:
    """The files that a path or glob names, in the order of their names.

    - `folder`: what a relative path is relative to, itself a path or URL.
    """
    place = pattern if is_url(pattern) or os.path.isabs(pattern) else joined(folder, pattern)
    if is_url(place):
        store, path = store_of(place)
        places = tuple(sorted(store.unstrip_protocol(one) for one in store.glob(path)))
    else:
        places = tuple(sorted(glob.glob(place, recursive=True)))
    if not places:
        raise InputError(f"{place}: names no file; check the path.")
    return places


def joined(folder: str, name: str) -> str:
    return f"{folder.rstrip('/')}/{name}" if is_url(folder) else os.path.join(folder, name)


def content(place: str) -> str:
    """What stands for the content of a file: its SHA-256, or of a URL the tag that its store gives it.

    A folder (of a ROS 2 bag) is all that lies in it.
    """
    if is_url(place):
        store, path = store_of(place)
        return str(store.ukey(path))
    digest = hashlib.sha256()
    path = Path(place)
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def at_hand(place: str, folder: Path) -> Path:
    """A local path of a file: what a URL names is copied into `folder`, by its own name."""
    if not is_url(place):
        return Path(place)
    store, path = store_of(place)
    local = folder / Path(path).name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        store.get(path, str(local), recursive=store.isdir(path))
    except OSError as error:
        raise InputError(f"{place}: cannot be fetched ({error}); check the URL and its rights.") from error
    return local
