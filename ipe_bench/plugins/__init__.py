"""Plugins: finding them, constructing their components from config, checking them, and starting new ones."""
