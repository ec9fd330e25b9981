"""Safety rates of filters with confidence intervals, on the same episodes for each filter."""
