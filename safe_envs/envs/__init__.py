"""A problem as a Gymnasium env, scalar and vectorized."""

# Before any module of this package, so that the ids are registered before one of them is imported.
import gymnasium  # noqa: F401
