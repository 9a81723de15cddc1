"""What every room uses: arrays and batches, statuses, errors, files, and what this machine offers."""
