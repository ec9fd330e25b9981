"""Values of a problem: how safe it can be made, and the filter that keeps a given probability."""
