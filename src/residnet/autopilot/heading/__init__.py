"""Heading controllers: laws, learned policies, their vessels and conditions."""
