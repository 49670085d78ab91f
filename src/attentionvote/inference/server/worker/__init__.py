"""Worker processes, in which bodies are read and poses estimated: whatever an input does there, the server goes on."""
