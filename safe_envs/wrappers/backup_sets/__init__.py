"""Terminal sets of backup laws, and the proof that they are kept."""
