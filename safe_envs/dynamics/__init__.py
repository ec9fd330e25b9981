"""Control-affine stochastic differential equations: symbols, derivatives, code, integrators."""
