"""Document 001 (Moreno-Salinas et al. 2019): regressions on random manoeuvres."""
