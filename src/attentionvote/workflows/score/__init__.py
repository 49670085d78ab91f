"""Result files of any method against the true poses."""
