"""How a process of the package begins, a command's or a worker's."""

import os
from pathlib import Path


def prepare() -> None:
    """Double precision, and compiled programs kept in the user's cache folder between runs."""
    # The compiler warns of its own slowness after two minutes, in words that look like a failure.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    from ._compiled import keep_in

    jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "jaxmarine"
        jax.config.update("jax_compilation_cache_dir", str(home))
        keep_in(home / "programs")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
