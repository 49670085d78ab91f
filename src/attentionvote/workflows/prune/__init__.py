"""Data, trainings, checkpoints and bundles that nobody refers to: shown, removed on request."""
