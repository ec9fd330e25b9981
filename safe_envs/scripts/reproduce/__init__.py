"""`safe-envs reproduce`: the thesis' tables and figures, ours beside the print."""
