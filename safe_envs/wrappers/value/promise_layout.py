"""Where the numbers are that kernels of a promise filter read and write.

`data` begins with the numbers that constants here name AT_..., and holds arrays after them; `work`,
the scratch array, begins with those that constants name IN_...
"""

AT_COORDINATES = 0
AT_INPUTS = 1
AT_SCENARIOS = 2
AT_BOXES = 3
AT_SCANNED = 4
AT_COARSE = 5
AT_STEPS = 6
AT_FIRST = 7
"""The control instant of the first tables."""
AT_PROBABILITY = 8
AT_REST = 9
"""What noise beyond all boxes adds to negative upper bounds."""
AT_COARSE_SPACING = 10
AT_SPACING = 11
AT_SEES_VALUES = 12
AT_IS_AFFINE = 13
AT_WEIGHTS = 14
"""From here on: places of the first entries of arrays."""
AT_SCANNED_INPUTS = 15
AT_COARSE_INPUTS = 16
AT_BOUNDS = 17
AT_MEANS = 18
"""Of the axes of the grid of smoothed tables, eight numbers each."""
AT_CELLS = 19
"""Of the axes of the grid of the lower envelope."""
AT_MEANS_SIZE = 20
AT_CELLS_SIZE = 21

IN_SPANS = 0
IN_SHIFTS = 8
IN_TRIED = 16
IN_CHOSEN = 20
IN_ORIGIN = 24
IN_POINT = 28
IN_ARRAYS = 32
"""From here on: values of boxes, values of scanned inputs, images, effects."""
