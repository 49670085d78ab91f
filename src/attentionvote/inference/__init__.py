"""The cell's side: a verified bundle in, poses out, and the server around it. No training stack in the process."""
