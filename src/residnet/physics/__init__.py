"""What is known of a vessel before any data: hull, actuators, environment.

Everything is batched and differentiable.
"""
