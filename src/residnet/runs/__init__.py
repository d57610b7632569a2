"""What a run is: its folder, its provenance, and the base class of all tasks."""
