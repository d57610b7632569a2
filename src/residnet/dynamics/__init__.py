"""Models that move: hybrid (baseline + head), simulated plants, and the one time loop that runs
them all.
"""
