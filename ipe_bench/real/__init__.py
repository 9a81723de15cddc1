"""Leads from a file of real readings to an answer."""
