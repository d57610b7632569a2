"""Heading controllers: classical laws, the neural policy, and the vessels that they steer."""
