"""The server's connections: how many, how long, and how each of them ends."""
