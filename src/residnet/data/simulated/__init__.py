"""Simulated trials: a plant, manoeuvres, disturbances and sensors."""
