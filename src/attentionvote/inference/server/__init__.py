"""The cell's HTTP server around one estimator."""
