"""How safe a problem can be at all: envelopes of its value by dynamic programming.

Let V_k(x) be the largest probability that an episode, which is at x at control instant k, stays in
the safe set until its end. A lower envelope L and an upper envelope H bound it on the cells of a
grid; `solve` computes both, `LookAhead` reads them, and the promise filter keeps what they allow.

Source: A. Abate, M. Prandini, J. Lygeros, S. Sastry, Probabilistic reachability and safety for
    controlled discrete time stochastic hybrid systems, Automatica 44, 2008; S. Summers,
    J. Lygeros, Verification of discrete time stochastic hybrid systems, Automatica 46, 2010.
"""
