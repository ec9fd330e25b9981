"""Safety problems: plant, model, barriers, bounds, start and task, built and checked."""
