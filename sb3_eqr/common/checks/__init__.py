"""Checks: legal arguments, environments that fit, and data and updates that are finite."""
