"""Double precision, which identification needs: single precision runs, and its answers are wrong."""

import jax


def need_double(what: str) -> None:
    """Raises ValueError unless jax computes in double precision; `what` begins the sentence, as `A fit`."""
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            f"{what} needs double precision: call `jax.config.update('jax_enable_x64', True)` first."
        )
