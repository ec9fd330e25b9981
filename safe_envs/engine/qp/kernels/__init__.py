"""The exact methods of the QPs for one state, as functions that can be compiled.

Every function is of floats and of float64 arrays that are passed in; none allocates. They run as
plain Python and give the same numbers compiled. Their answers are those of
`safe_envs.engine.qp.dispatch`, infeasible QPs included. Data that are not finite give inputs or
margins that are not finite: the caller looks at these.
"""
