"""What a safety problem is: plant, model, barriers, bounds, start, task, and how one is built and
checked.
"""
