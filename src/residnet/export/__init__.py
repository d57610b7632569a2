"""Leaving residnet: TorchScript modules for controllers, each with its card and its parity check.
"""
