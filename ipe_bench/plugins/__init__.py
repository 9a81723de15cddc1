"""Finds plugins, constructs their components from config, checks them, and starts new ones."""
