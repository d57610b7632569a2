"""What `import residnet` offers, in plain Python values; a name is loaded when it is first used."""
