"""Methods without learning that a user would take today, measured beside the network.

OpenCV is imported only when a detector is made; it comes with the extra ``benchmark``.
"""
