"""A problem as a Gymnasium env, scalar and vectorized."""
