"""The environment that acts on a vessel: wind and waves."""
