"""Every fast path beside its references (`make bench`), and a server under load."""
