"""Register, gate, promote, roll back: which model of a part its cells fetch, why, and since when.

Beside ``tracking`` the only place that knows MLflow.
"""
