"""`safe-envs reproduce`: the thesis' tables and figures, reproduced."""
