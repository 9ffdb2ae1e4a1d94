"""Files at the border: read and check TOML, write whole files or none."""

import contextlib
import difflib
import os
import re
import tomllib
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import pydantic

from ._errors import InputError

# Larger than any file of ours that is read whole into memory.
MOST_BYTES = 2**31
_MOST_TOML_BYTES = 10_000_000
# How deep tables may stand in one another. A dotted key of many parts is looked for before the file is
# parsed, as the parser takes memory that goes with the square of them.
_MOST_LEVELS = 32
_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_DEEP_KEY = re.compile(rf"(?<![\w-]){_PART}(?:\s*\.\s*{_PART}){{{_MOST_LEVELS},}}")
_Model = TypeVar("_Model", bound=pydantic.BaseModel)


def existing_file(path: str | os.PathLike[str]) -> Path:
    """The path, if a file stands there."""
    path = Path(path)
    try:
        if path.is_file():
            return path
        folder = "it is a folder (that of a ROS 2 bag has a metadata.yaml)"
        found = folder if path.is_dir() else "there is no such file"
    except (OSError, ValueError) as error:  # a name too long for the system, a null byte
        found = _reason(error)
    raise InputError(f"{path}: cannot be read, because {found}; check the path.")


def file_to_hold(path: str | os.PathLike[str], most: int = MOST_BYTES) -> Path:
    """The path, if a file of at most `most` bytes stands there: one that is read into memory whole."""
    path = existing_file(path)
    size = path.stat().st_size
    if size > most:
        raise InputError(
            f"{path}: has {size / 1e6:.0f} MB, but such a file has at most {most / 1e6:.0f} MB; check that "
            "it is the right file."
        )
    return path


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables of a TOML file; every way to fail is one `InputError`."""
    path = file_to_hold(path, _MOST_TOML_BYTES)
    try:
        text = path.read_bytes().decode("utf-8-sig")
        if _DEEP_KEY.search(text):
            raise RecursionError
        tables = tomllib.loads(text)
        if _levels(tables) > _MOST_LEVELS:
            raise RecursionError
        return tables
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8 TOML.") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not valid TOML: {error}; correct it there.") from error
    except (RecursionError, ValueError) as error:
        raise InputError(
            f"{path}: is not usable TOML ({type(error).__name__}: nested too deeply, or a number "
            "with too many digits); check that it is the right file."
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read, because {_reason(error)}; check its rights.") from error


def _levels(value: dict | list) -> int:
    """How deep tables and lists stand in one another, counted without recursion."""
    inside: list[Any] = [value]
    levels = 0
    while inside:
        parts = (part for one in inside for part in (one.values() if isinstance(one, dict) else one))
        inside = [part for part in parts if isinstance(part, dict | list)]
        levels += 1
    return levels


@contextlib.contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A path to write to; it becomes `path` at the end, so that no reader sees half a file.

    The temporary name keeps the suffixes, because writers choose their format by them.
    """
    path = Path(path)
    beside = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield beside
        os.replace(beside, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written, because {_reason(error)}; check the folder.") from error
    finally:
        # The sentence above must not give way to a second failure.
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)


def write_together(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes files by their paths in a folder: all are beside their places before one moves.

    The first one moves last: where a killed run has moved some, it is still the one before.
    """
    with contextlib.ExitStack() as stack:
        for name, content in files.items():
            stack.enter_context(written_whole(folder / name)).write_bytes(content)


def validated(model: type[_Model], data: object, source: str) -> _Model:
    """`data` as a `model`; what is wrong with it becomes one sentence that begins with `source`.

    A field's `description` is what its value must be, as the sentence says it.
    """
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        problems = error.errors(include_url=False)
        others = len(problems) - 1
        more = f" ({others} other problem{'s' * (others > 1)}.)" if others else ""
        # a misspelt key is missing and unknown at once, and the unknown one tells what happened
        first = next((one for one in problems if one["type"] == "extra_forbidden"), problems[0])
        raise InputError(f"{source}: {_problem(model, first)}{more}") from error


def listed(names: Iterable[str]) -> str:
    """Names for a sentence, the first twenty of them."""
    quoted = [f"`{name}`" for name in names]
    return ", ".join(quoted[:20]) + (", ..." if len(quoted) > 20 else "")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: the nearest known ones, or all of them."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    if near:
        return f"did you mean `{near[0]}`?"
    return f"known are {', '.join(known)}." if known else "there are none."


def _problem(model: type[pydantic.BaseModel], problem: Any) -> str:
    loc = problem["loc"]
    key, (known, description) = _key(loc), _field(model, loc)
    if problem["type"] == "missing":
        return f"`{key}` is missing; give {description}."
    if problem["type"] == "extra_forbidden":
        return f"`{key}` is an unknown key; {did_you_mean(str(loc[-1]), known)}"
    if problem["type"] == "value_error":
        message = str(problem["ctx"]["error"])
        return f"`{key}` {message}" if key else message
    return f"`{key}` is {_short(problem['input'])}, but must be {description}."


def _field(model: type[pydantic.BaseModel], loc: Sequence[int | str]) -> tuple[list[str], str]:
    """The keys known beside the last part of `loc`, and the description of that field."""
    known: list[str] = []
    description = "a table"
    inside: type[pydantic.BaseModel] | None = model
    names = [part for part in loc if isinstance(part, str)]
    for depth, part in enumerate(names, start=1):
        if inside is None:
            break
        fields = {field.alias or name: field for name, field in inside.model_fields.items()}
        known = list(fields)
        if part in fields:
            description = fields[part].description or description
            inside = _model_in(fields[part].annotation)
        elif depth == len(names):
            break
        # else it is a user's own key of a dictionary of models, and the model comes next
    return known, description


def _model_in(annotation: object) -> type[pydantic.BaseModel] | None:
    """The model in an annotation such as `Sensors | None` or `tuple[Thruster, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        return annotation
    found = (_model_in(part) for part in typing.get_args(annotation))
    return next((model for model in found if model is not None), None)


def _key(loc: Sequence[int | str]) -> str:
    """('thruster', 1, 'lag') as `thruster[2].lag`: entries are counted from one."""
    key = ""
    for part in loc:
        key += f"[{part + 1}]" if isinstance(part, int) else f".{part}"
    return key.removeprefix(".")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()
