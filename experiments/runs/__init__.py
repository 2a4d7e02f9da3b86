"""What a run is: its specification, and its directory on disk."""
