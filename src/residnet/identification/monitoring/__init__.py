"""A watch over a model in service: has the vessel changed, or have its data?"""
