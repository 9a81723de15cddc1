"""Holds what the whole package uses: arrays and batches, statuses, errors, files, and facts about
this machine."""
