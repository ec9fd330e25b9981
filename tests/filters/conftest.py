"""Problems, and things learned of them in a moment."""

from tests.wrappers.conftest import (  # noqa: F401
    cubic,
    diffusion,
    disk,
    gap,
    gap_posterior,
    network,
    posterior,
    residual,
    rotors,
    top,
)
