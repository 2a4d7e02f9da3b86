"""What the report page is made of; `experiments.analysis.page` is the way in."""
