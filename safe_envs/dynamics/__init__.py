"""Control-affine stochastic differential equations: symbols, derivatives, generated code and
integrators.
"""
