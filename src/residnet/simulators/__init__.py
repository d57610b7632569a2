"""Simulators that run a vessel or a learned model: Gymnasium, and ArduPilot's JSON interface."""
