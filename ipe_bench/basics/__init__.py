"""What the whole package uses: arrays and batches, statuses, errors, files, and what this machine offers."""
