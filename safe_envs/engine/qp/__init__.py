"""The QPs of the filters: min 1/2 |u - u_nom|^2_W subject to A u + b >= 0 and lo <= u <= hi."""
