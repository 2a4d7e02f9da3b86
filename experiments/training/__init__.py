"""What happens while a run runs."""
