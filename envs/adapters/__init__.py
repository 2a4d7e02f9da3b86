"""Environments of other packages as ours, and ours as Gymnasium's."""
