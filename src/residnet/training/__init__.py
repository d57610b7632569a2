"""Fitting heads: closed form, and by gradient through one-step and free-run losses (Lightning,
imported only when training).
"""
