"""Heading policies with observer and predictor, and a recurrent network beside their law."""
