"""Training: losses, schedule, the Lightning module, callbacks."""
