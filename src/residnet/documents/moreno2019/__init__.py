"""Document 001 (Moreno et al. 2019): ridge, kernel ridge and symbolic regression on random
manoeuvres.
"""
