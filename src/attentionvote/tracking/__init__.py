"""Experiment tracking: one thin logger on MLflow, with the registry the only place that knows MLflow."""
