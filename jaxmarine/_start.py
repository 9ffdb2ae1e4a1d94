"""How a process of the package begins: in which precision, and with which compiled programs."""

import os
import warnings
from pathlib import Path


def prepare() -> None:
    """Double precision, and compiled programs kept between runs: for commands and workers."""
    # The compiler warns of its own slowness after two minutes, in words that look like a failure.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # A search for a disturbance's sizes that ends so goes on from where it ended.
    warnings.filterwarnings("ignore", "The line search algorithm did not converge")
    import jax

    jax.config.update("jax_enable_x64", True)
    keep_programs()


def keep_programs(folder: str | Path | None = None) -> None:
    """Keeps compiled programs in a folder, from which later processes load them instead of compiling.

    - `folder`: by default that of the command line, `~/.cache/jaxmarine` or what `XDG_CACHE_HOME` says. What
      lies in it is loaded as code: take one that is yours.

    Where `JAX_COMPILATION_CACHE_DIR` is set, JAX keeps them as it always does: that saves compiling, not
    tracing.
    """
    import jax

    from ._compiled import keep_in

    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if folder is None and "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    caches = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    home = caches / "jaxmarine" if folder is None else Path(folder)
    jax.config.update("jax_compilation_cache_dir", str(home))
    keep_in(home / "programs")
