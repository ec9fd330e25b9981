"""What is learned: networks, features, distributions, and the models made of them."""
