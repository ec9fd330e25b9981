"""Pictures of the envs, drawn by pygame, which is imported when the first one is."""
