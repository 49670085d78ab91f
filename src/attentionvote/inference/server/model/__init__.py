"""The model that serves: loading, testing, exchanging and keeping it."""
