"""Training by gradient and refits through rollouts; Lightning is imported when it is used."""
