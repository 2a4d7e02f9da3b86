"""Finished runs: arrays in, tables and pictures out."""
