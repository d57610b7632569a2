"""Physics of vessels: hull, actuators and environment, batched and differentiable."""
