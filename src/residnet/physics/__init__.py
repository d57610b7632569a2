"""What is known of a vessel: rigid body, hydrodynamics, actuators, environment. Everything batched
and differentiable.
"""
