"""The frame of every verb: entry, configuration, grid, executors, errors."""
